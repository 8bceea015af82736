"""Files that are complete or absent, read within limits, and wrong in plain words and by line.

atomic writes, reading reads, hashing identifies, messages explains. yaml_file, model and model_file:
checked YAML. registry: formats by name. corners_vnl: board corners of other programs.
"""
