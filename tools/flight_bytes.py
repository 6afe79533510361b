#!/usr/bin/env python3
"""What a viewer loads along a flight over a tileset of ours when it is to see roofs and façades to so many pixels.

    python3 tools/flight_bytes.py SEMANTIC UNIFORM [--sse 16] [--heights 60,120,400]

Both folders are built from one input: one with budgets per class, one with the strictest of them for all
(`--budget terrain=0.05,clutter=0.05`). A tile is refined where its certified bound of roofs and façades, seen from the
camera, is larger than `--sse` pixels of a 1080-line picture with a field of view of 60°: so both show these classes
equally well. The flight crosses the model along both diagonals, 32 places each, and looks everywhere. Printed are the
bytes of all tiles loaded on the way and the most that are drawn at one place. No packages needed.
"""

import argparse
import json
import math
import os

LINES, FIELD_DEG, PLACES = 1080, 60.0, 32


def key_error_m(tile):
    numbers = tile.get("metadata", {}).get("properties", {})
    # NaN stands for a class that is not in the tile.
    bounds = [numbers.get(name) for name in ("roofBound", "facadeBound")]
    return max([b for b in bounds if b is not None and b == b], default=0.0)


def distance_m(box, place):
    middle, axes = box[:3], (box[3:6], box[6:9], box[9:12])
    offset = [p - m for p, m in zip(place, middle)]
    square = 0.0
    for axis in axes:
        half = math.hypot(*axis)
        along = abs(sum(o * a for o, a in zip(offset, axis))) / half if half else 0.0
        square += max(along - half, 0.0) ** 2
    return math.sqrt(square)


def drawn(tile, place, sse, loaded):
    """Bytes drawn from a place; adds what is loaded, parents too, as a viewer loads them first."""
    loaded.add(tile["content"]["uri"])
    px_per_m = LINES / (2.0 * math.tan(math.radians(FIELD_DEG / 2.0)) * max(distance_m(tile["boundingVolume"]["box"], place), 1e-3))
    children = tile.get("children", [])
    if children and tile["error_m"] * px_per_m > sse:
        return sum(drawn(child, place, sse, loaded) for child in children)
    return tile["bytes"]


def prepare(tile, folder):
    tile["bytes"] = os.path.getsize(os.path.join(folder, tile["content"]["uri"]))
    children = [prepare(child, folder) for child in tile.get("children", [])]
    tile["error_m"] = max([key_error_m(tile)] + [child["error_m"] for child in children])
    return tile


def flight(root, height_m):
    x, y, z = root["boundingVolume"]["box"][:3]
    half = [root["boundingVolume"]["box"][i] for i in (3, 7, 11)]
    steps = [2.0 * i / (PLACES - 1) - 1.0 for i in range(PLACES)]
    top = z + half[2] + height_m
    return [(x + s * half[0], y + s * half[1], top) for s in steps] + [(x + s * half[0], y - s * half[1], top) for s in steps]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("semantic")
    parser.add_argument("uniform")
    parser.add_argument("--sse", type=float, default=16.0)
    parser.add_argument("--heights", default="60,120,400")
    asked = parser.parse_args()
    roots = {}
    for name in (asked.semantic, asked.uniform):
        with open(os.path.join(name, "tileset.json")) as file:
            roots[name] = prepare(json.load(file)["root"], name)
    print("height m  tileset      loaded MB  most drawn MB  tiles")
    all_heights = [0, 0]
    for height in (float(h) for h in asked.heights.split(",")):
        sums = []
        for kind, name in (("per class", asked.semantic), ("uniform", asked.uniform)):
            most, loaded = 0, set()
            for place in flight(roots[name], height):
                most = max(most, drawn(roots[name], place, asked.sse, loaded))
            total = sum(os.path.getsize(os.path.join(name, uri)) for uri in loaded)
            sums.append(total)
            print(f"{height:8.0f}  {kind:<11} {total / 1e6:10.2f} {most / 1e6:14.2f} {len(loaded):6}")
        all_heights = [a + s for a, s in zip(all_heights, sums)]
        print(f"{'':8}  ratio       {sums[0] / sums[1]:10.2f}")
    print(f"all       ratio       {all_heights[0] / all_heights[1]:10.2f}")


if __name__ == "__main__":
    main()
