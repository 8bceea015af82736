"""From range images of one person to a body cloud and a closed mesh.

Read in this order: cleaning, smoothing (quadratic_fit), voxel_thinning, consistency, brightness,
merging, pose_variance, regions, meshing (signed_distances, hole_filling, support), verdict,
storage.
"""
