"""Reading what anyone may have touched, and writing what is whole or not there at all.

Written: atomic, json_file, hashing, locking, relative_text. Read: regular (files, not pipes), yaml_file
with model and model_file (errors by line), npz_file, corners_vnl. os_errors: refusals in words.
registry: formats and codes by name, one file each.
"""
