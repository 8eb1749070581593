"""Lost in the woods: from the laboratory's .mat file to a folder of tables.

    python examples/lost_in_the_woods.py dataset2.mat woods
    jaxslam fit woods --calibrate heading,scale,range,delay --fix "range scale" --write --out fitted
    jaxslam run --dataset table woods --filters ekf,right_invariant --out out

A robot drives among 17 posts for 21 minutes; a laser gives range and bearing of each, and cameras
the true path (University of Toronto, T. D. Barfoot). The settings have what the file and the data
sheet of the laser say; errors of odometry and laser, and their noises, are for the log to tell.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.io import loadmat

SETTINGS = """name = "Lost in the woods"
source = "T. D. Barfoot, State Estimation for Robotics, 2017; University of Toronto"
[motion]
model = "velocity"
noise = [{v:.4f}, {om:.4f}, 0.0]
[sensor]
noise = [{r:.4f}, {b:.4f}]
mount = [{d:.4f}, 0.0, 0.0]
across = 0.03     # posts are wider than a beam, so bearings of near ones are worse
max_range = 5.6   # the laser writes 5.635 m where it met nothing
[filter]
start_noise = [0.01, 0.01, 0.01]
spacing = {spacing}
"""


def write_tables(mat: str | Path, folder: str | Path, spacing: float = 3.0) -> Path:
    """Write the tables and the settings; returns the folder."""
    file = {name: np.squeeze(value) for name, value in loadmat(mat).items() if name[0] != "_"}
    time = file["t"].astype(float)
    row, post = np.nonzero(file["r"])  # 0 where a post is not seen
    known = file["true_valid"] > 0
    truth = np.column_stack([time, file["x_true"], file["y_true"], file["th_true"]])
    seen = np.column_stack([time[row], post + 1, file["r"][row, post], file["b"][row, post]])
    tables = {
        "odometry": ("t [s],v [m/s],omega [rad/s]", np.column_stack([time, file["v"], file["om"]])),
        "measurements": ("t [s],tag,range [m],bearing [rad]", seen),
        "truth": ("t [s],x [m],y [m],theta [rad]", truth[known]),
        "landmarks": ("tag,x [m],y [m]", np.column_stack([np.arange(1, 18), file["l"]])),
    }
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, (header, table) in tables.items():
        np.savetxt(
            folder / f"{name}.csv", table, fmt="%.12g", delimiter=",", header=header, comments=""
        )
    sigma = {name: float(np.sqrt(file[f"{name}_var"])) for name in ("v", "om", "r", "b")}
    text = SETTINGS.format(**sigma, d=float(file["d"]), spacing=spacing)
    (folder / "dataset.toml").write_text(text)
    return folder


if __name__ == "__main__":
    print(f"wrote {write_tables(*sys.argv[1:3])}")
