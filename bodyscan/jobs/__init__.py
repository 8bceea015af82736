"""Batches: every scan of a day as a job in a process and a folder of its own.

Read in this order: pipeline (what to do), discovery (which jobs there are), job (one folder),
stages (the steps), plan (what has to be done again, and why), worker (the job's process),
supervision (starts it, and tries again), allocation (memory and cores), batch (many jobs), display
and summary; cluster and object_storage (on many machines). watching, with inbox and
resident_worker: scans fused while they arrive. verification, forgetting: checking and removing what
is kept of a day.
"""
