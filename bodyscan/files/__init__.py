"""Files that are complete or absent, read within limits, and wrong in plain words and by line."""
