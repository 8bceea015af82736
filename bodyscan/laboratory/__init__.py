"""The chapter's experiments repeated, and the rival models it is compared with.

reproduce runs them: apparatus, approaches (rival_cameras, rival_projectors), measuring, figures.
"""
