#!/usr/bin/env python3
"""Lays copies of one OBJ side by side: a city of any size from one scan, to see how a build grows with its input.

    python3 tools/tile_copies.py model.obj OUT 4 4

writes OUT/00_00/model.obj … OUT/03_03/model.obj, shifted by the model's own extent, one copy of its MTL and images in
OUT/shared, and nothing that was not in the model. No packages needed.
"""

import shutil
import sys
from pathlib import Path


def extent(model):
    low, high = [float("inf")] * 2, [float("-inf")] * 2
    with open(model, "rb") as lines:
        for line in lines:
            if line.startswith(b"v "):
                at = [float(word) for word in line.split()[1:3]]
                low = [min(a, b) for a, b in zip(low, at)]
                high = [max(a, b) for a, b in zip(high, at)]
    return [b - a for a, b in zip(low, high)]


def share(model, folder):
    """Copies what the model names; returns the names of its MTL files."""
    folder.mkdir(parents=True, exist_ok=True)
    libraries = []
    with open(model, "rb") as lines:
        for line in lines:
            if line.startswith(b"mtllib"):
                libraries.append(line.split(None, 1)[1].strip().decode())
            elif line.startswith(b"v "):
                break
    for name in libraries:
        shutil.copy(model.parent / name, folder / Path(name).name)
        for line in (model.parent / name).read_text(errors="replace").splitlines():
            words = line.split()
            if words and words[0].lower().startswith("map_"):
                image = model.parent / words[-1]
                if image.is_file():
                    shutil.copy(image, folder / words[-1])
    return libraries


def copy(model, to, shift):
    to.parent.mkdir(parents=True, exist_ok=True)
    with open(model, "rb") as lines, open(to, "wb") as out:
        for line in lines:
            if line.startswith(b"v "):
                words = line.split()
                x, y = (float(words[k + 1]) + shift[k] for k in range(2))
                out.write(b"v %.6f %.6f %s\n" % (x, y, b" ".join(words[3:])))
            elif line.startswith(b"mtllib"):
                out.write(b"mtllib ../shared/" + Path(line.split(None, 1)[1].strip().decode()).name.encode() + b"\n")
            else:
                out.write(line)


def main():
    model, out, columns, rows = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    size = extent(model)
    share(model, out / "shared")
    for row in range(rows):
        for column in range(columns):
            to = out / f"{column:02}_{row:02}" / model.name
            copy(model, to, (column * size[0], row * size[1]))
            print(to)


if __name__ == "__main__":
    main()
