"""Reading files that anyone may have edited, and writing files that are complete or absent.

Writing: atomic, json_file, hashing, locking, relative_text. Reading: regular (files, not pipes),
yaml_file with model and model_file (errors by line), npz_file, corners_vnl. os_errors: system
errors in words. registry: formats and codes by name, one file each.
"""
