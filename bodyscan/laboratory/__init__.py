"""The chapter's experiments repeated, and the rival models it is compared with.

reproduce runs them: apparatus, approaches (rivals), measuring.
"""
