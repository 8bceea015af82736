"""The chapter's experiments (section 4) repeated on a simulation of its own set-up."""
