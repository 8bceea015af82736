"""Batches: every scan of a day as a job in a process and a folder of its own.

Read in this order: pipeline (what to do), job (one folder, and which jobs there are), stages (the
steps), plan (what has to run again), worker (the job's process), supervision (starts it, tries
again), batch (many jobs, on many machines), display and summary; object_storage.
watching: scans fused while they arrive. verification, forgetting: checking and removing what is
kept of a day.
"""
