"""From a pair's stripe map to a range image.

range_image (what it is), scan_volume (which stripes are looked for), triangulation (rays meet light
sheets), two_ways (stripes of both directions).
"""
