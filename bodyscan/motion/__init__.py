"""Non-rigid motion of a person between the pairs' captures: estimated, removed, and reported."""
