"""Files beside a recording's own that are read with it."""

import re
from pathlib import Path

_TRUTH_ENDINGS = {"_data.hdf5": ("_gt.hdf5",), "_data.h5": ("_pose_gt.h5", "_depth_gt.h5")}


def companions(path: Path) -> list[Path]:
    """Find the files beside a recording's: ground truth, triggers, and DSEC's rectifying map."""
    found = truth(path)
    for other in (triggers(path), rectify_map(path)):
        found += [] if other is None else [other]
    return found


def truth(path: Path) -> list[Path]:
    """Find the files of ground truth that exist."""
    found = []
    for end, others in _TRUTH_ENDINGS.items():
        if path.name.endswith(end):
            found += [path.with_name(path.name.removesuffix(end) + other) for other in others]
    found += [folder / stamps for folder, stamps in truth_folders(path)]
    return [file for file in found if file.is_file()]


def truth_folders(path: Path) -> list[tuple[Path, str]]:
    """Find the folders of ground truth of DSEC's left camera, and the names of their times."""
    if path.name != "events.h5":
        return []
    if path.parts[-3:-1] == ("events", "left"):
        sequence = path.parents[2]
    elif path.parent.name == "events_left":
        sequence = path.parents[1]
    else:
        return []
    found = []
    for kind, apart, stamps in (
        ("flow", "train_optical_flow", "forward_timestamps.txt"),
        ("disparity", "train_disparity", "timestamps.txt"),
    ):
        places = [place / kind for place in (sequence, sequence.parents[1] / apart / sequence.name)]
        found += [(place, stamps) for place in places if place.is_dir()][:1]
    return found


def triggers(path: Path) -> Path | None:
    """Find the triggers NAME_trigger.dat of Prophesee's events NAME_cd.dat or NAME_td.dat."""
    name = re.sub(r"_(cd|td)(\.dat)$", r"_trigger\2", path.name, flags=re.IGNORECASE)
    return _existing(path, name)


def rectify_map(path: Path) -> Path | None:
    """Find the file of the places of a DSEC camera's pixels in the rectified image."""
    return _existing(path, "rectify_map.h5") if path.suffix in (".h5", ".hdf5") else None


def images(path: Path) -> Path | None:
    """Find the folder of the images of DSEC's frame camera beside the events in `path`."""
    if path.name != "events.h5" or path.parts[-3:-2] != ("events",):
        return None
    folder = path.parents[2] / "images" / path.parent.name
    return next((one for one in (folder / "rectified", folder) if one.is_dir()), None)


def _existing(path: Path, name: str) -> Path | None:
    other = path.with_name(name)
    return other if name != path.name and other.is_file() else None
