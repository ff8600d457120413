"""A copy of config/sim.toml, scaled down: the same camera pixels see one projector pixel.

    small_twin.py FOLDER [SCALE] [TABLE.KEY=VALUE ...]

writes FOLDER/polscan.toml, its calibration and its scenes. VALUE is TOML and replaces a key or adds it to its table.
"""

import re
import shutil
import sys
import tomllib
from pathlib import Path

CONFIG = Path(__file__).resolve().parents[2] / "config"


def size(scale):
    return lambda text: "[" + ", ".join(str(int(int(side) / scale)) for side in text.strip("[]").split(",")) + "]"


def focal(scale):
    return lambda text: repr(float(text) / scale)


def coordinate(number, scale):
    # Pixel centres lie at integers, so that a coordinate shrinks about -1/2.
    return (number + 0.5) / scale - 0.5


def point(scale):
    return lambda text: repr([coordinate(float(one), scale) for one in text.strip("[]").split(",")])


def matrix(scale):
    def shrink(text):
        rows = tomllib.loads("rows = " + text)["rows"]
        for index in range(2):
            rows[index][index] /= scale
            rows[index][2] = coordinate(rows[index][2], scale)
        return repr(rows)

    return shrink


def rewrite(text, rules):
    """Gives each `key = value` line that a rule names a new value; a rule that nothing matches is an error."""
    table, found, lines = "", set(), []
    for line in text.splitlines():
        if header := re.fullmatch(r"\[([\w.]+)\]\s*", line):
            table = header[1]
        elif (pair := re.fullmatch(r"(\w+) = (.*)", line)) and (name := f"{table}.{pair[1]}") in rules:
            line = f"{pair[1]} = {rules[name](pair[2])}"
            found.add(name)
        lines.append(line)
    if missing := set(rules) - found:
        raise SystemExit(f"config/ has changed: {', '.join(sorted(missing))} not found")
    return "\n".join(lines) + "\n"


def set_key(text, name, value):
    table, key = name.rsplit(".", 1)
    try:
        return rewrite(text, {name: lambda _: value})
    except SystemExit:
        header = f"[{table}]\n"
        if header in text:
            return text.replace(header, f"{header}{key} = {value}\n", 1)
        return f"{text}\n{header}{key} = {value}\n"


def write(folder, scale=4.0, changes=()):
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    devices = {}
    lenses = {}
    for device in ("camera", "projector"):
        devices[f"sim.{device}.size"] = size(scale)
        devices[f"sim.{device}.focal_px"] = focal(scale)
        lenses[f"{device}.size"] = size(scale)
        lenses[f"{device}.matrix"] = matrix(scale)
    devices["sim.projector.principal_point_px"] = point(scale)
    config = rewrite((CONFIG / "sim.toml").read_text(), devices)
    for name, value in changes:
        config = set_key(config, name, value)
    tomllib.loads(config)
    (folder / "polscan.toml").write_text(config)
    calibration = rewrite((CONFIG / "sim-calibration.toml").read_text(), lenses)
    (folder / "sim-calibration.toml").write_text(calibration)
    shutil.copytree(CONFIG / "scenes", folder / "scenes", dirs_exist_ok=True)
    return folder / "polscan.toml"


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    scale = float(sys.argv[2]) if len(sys.argv) > 2 else 4.0
    print(write(sys.argv[1], scale, [change.split("=", 1) for change in sys.argv[3:]]))
