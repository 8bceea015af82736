"""The chapter's experiments repeated, and the rival models it is compared with.

reproduce runs them: apparatus, chapter_captures, calibrating (approaches, rival_cameras,
rival_projectors), measuring, text, figures.
"""
