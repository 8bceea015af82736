"""The chapter's experiments (4) again, on its own set-up simulated."""
