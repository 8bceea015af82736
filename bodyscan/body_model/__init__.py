"""A parametric body with free data, and its fit to a scan."""
