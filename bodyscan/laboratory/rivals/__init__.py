"""The models with which the chapter is compared (1, 4.2), all as `Camera` and `LightSheets`."""
