"""The rig file: what a rig consists of, how its images are named, and its mistakes by line."""
