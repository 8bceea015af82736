"""One pair, step by step, as in a notebook: how flat does it measure a flat board?

With BODYSCAN_CAPTURES, the folder of real captures, it uses a real camera and projector; otherwise
simulated ones. Beyond `bodyscan.api` it uses inner modules, whose names may change.
"""

# %% A rig of one pair, and its captures of a board
import os
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

import bodyscan
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.captures.folder import open_captures
from bodyscan.reconstruction.triangulation import reconstruct_range_image
from bodyscan.rig.frame_names import CaptureFolder
from bodyscan.simulation import simulate
from bodyscan.workflows.decode import decode_sequence

RIGS = Path(__file__).parents[1] / "rigs"
if "BODYSCAN_CAPTURES" in os.environ:
    rig_file = RIGS / "procam-board.yaml"
    folder = CaptureFolder(folder=str(Path(os.environ["BODYSCAN_CAPTURES"]) / "procam-board"))
    rig = bodyscan.load_rig(rig_file).model_copy(update={"calibration": (folder,)})
else:
    workspace = Path(mkdtemp())
    simulate(RIGS / "one-pair.yaml", workspace, scale=0.5, board_shots=5)
    rig_file = workspace / "rig.yaml"
    rig = bodyscan.load_rig(rig_file)
captures = open_captures(rig, rig_file)

# %% Calibrate: the camera, and the light of every stripe
calibration = bodyscan.calibrate_rig(rig, folder=rig_file.parent)
((name, pair),) = calibration.pairs.items()
print(f"corners {pair.quality.corners_rms_px:.3f} px RMS, light: {pair.quality.light_model}")

# %% Decode: which stripe lit each pixel, as a real number
sequence = next(sequence for sequence in captures.sequences if sequence.has_stripes)
stripes = decode_sequence(sequence, rig.pair(name))
print(f"{np.isfinite(stripes.s).mean():.0%} of the pixels have a stripe")

# %% Triangulate: where a pixel's ray meets its stripe's light sheet; (N, 3) mm, camera frame
image = reconstruct_range_image(pair, stripes)
points = image.points[image.valid].astype(float)

# %% Compare with the board: its corners give its pose
board = rig.boards[0]
rig_from_board = calibration.rig_from_board[sequence.shot, board.name]
board_from_camera = rig_from_board.inverse() @ calibration.rig_from_camera[name]
on_board, corners = board_from_camera.apply(points), compute_corner_points(board)
inside = np.all(
    (on_board > corners.min(0) - [0, 0, 5]) & (on_board < corners.max(0) + [0, 0, 5]), 1
)
height = on_board[inside, 2]
print(f"{inside.sum()} points, {height.mean():+.3f} mm off the board, {height.std():.3f} mm RMS")
