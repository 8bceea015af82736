"""The command line: main, the commands of builder, operator and laboratory, and what these share.

options (each declared once), console (what is told while work goes on), tables, interruption (Ctrl-C).
"""
