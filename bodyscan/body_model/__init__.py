"""A parametric body with free data, laid over a scan.

template: shapes, skeleton, parts, landmarks. fitting: shape and pose, then a smooth residual.
registered: the scan and the template on it; skinned: that with its skeleton, for animation.
"""
