"""A page for the people at a rig, served by the rig's own computer: `bodyscan station`.

serving (its start), server (addresses and answers), guard (who may ask), feed (events to every open
page); day (scans and what people decided), rig_history (what scans tell of the rig), board_tour (a
board carried round), operation (the watch, the board and the capture, each in a thread). pages: what a
browser shows.
"""
