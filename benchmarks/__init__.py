"""Speed and accuracy, measured by one command: `python -m benchmarks` (`make bench`)."""
