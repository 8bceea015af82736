"""The chapter's experiments repeated, and the rival models it is compared with.

reproduce runs them all: chapter (apparatus, scenes, captures, calibrating, measuring, text), rivals
(other models of camera and projector), figures. simulated_acceptance: artefacts measured in a
simulated rig.
"""
