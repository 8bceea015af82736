"""The models the chapter is compared with (1, 4.2), all as `Camera` and `LightSheets`."""
