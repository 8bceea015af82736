"""Batches: every scan of a day as a job in a process and a folder of its own.

Read in this order: pipeline (what is asked for), job (one folder), stages (what is done), plan (what
has to be done again, and why), worker (the job's process), supervision (what starts it, and tries
again), batch (many of them), cluster (on many machines).
"""
