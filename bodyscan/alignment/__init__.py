"""Range images brought together where they overlap, and the subject's sway taken out of them.

Read in this order: icp (the rounds), matching (which points are the same spot), overlap_equations
(what they ask for, and the joint step), sway (how far a subject is believed to move), and
object_refinement (the same on an object that stands still).
"""
