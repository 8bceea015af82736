"""Batches: every scan of a day as a job in a process and a folder of its own.

Read in this order: pipeline (what is asked for), discovery (which jobs there are), job (one folder),
stages (what is done), plan (what has to be done again, and why), worker (the job's process),
supervision (what starts it, and tries again), allocation (memory and cores), batch (many of them),
display and summary; cluster and object_storage (on many machines). watching, with inbox and
resident_worker: scans fused while they arrive. verification, forgetting: what is kept of a day.
"""
