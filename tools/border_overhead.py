#!/usr/bin/env python3
"""How many more triangles a surface has because it was cut into tiles.

    python3 tools/border_overhead.py ROOFTILE INPUT [--set key=value]...

Builds INPUT once as it is and then as one cell, simplified to one step after the other. For each level of tiles it prints
their triangles (skirts left out) over those that the uncut surface has at the same scale in the same cells: counted by
their middles, and between two steps on a straight line of the logarithms, for cutting moves the median edge from which
scales are counted. Certified errors of both stand beside them. Textures cost most of the time and change nothing: a
model without any will do. No packages needed.
"""

import argparse
import json
import math
import os
import re
import struct
import subprocess
import sys
import tempfile

ONE_CELL = ["levels.leaf_faces=100000000", "levels.leaf_texels=1000000000000", "write.tile_bytes=1000000000000"]
SKIRTS = 4  # Feature ids from here on are skirts.


def build(program, source, out, sets):
    """The scales of the levels, finest first."""
    args = [program, "build", source, "-o", out] + [a for s in sets for a in ("--set", s)]
    run = subprocess.run(args, stderr=subprocess.PIPE, text=True)
    if run.returncode:
        sys.exit(run.stderr)
    scales = re.search(r"levels at scale ([0-9., ]*[0-9])", run.stderr)
    return [float(s) for s in scales.group(1).split(", ")] if scales else []


def inner_tiles(folder):
    """Level, path and certified error of every tile that is not a leaf."""
    with open(os.path.join(folder, "tileset.json")) as file:
        open_tiles, found = [json.load(file)["root"]], []
    while open_tiles:
        tile = open_tiles.pop()
        numbers = tile["metadata"]["properties"]
        if tile.get("children"):
            found.append((numbers["level"], os.path.join(folder, tile["content"]["uri"]), numbers["geometryError"]))
        open_tiles += tile.get("children", [])
    return found


def triangles(path):
    """Corners of a tile's triangles in plan, skirts left out."""
    with open(path, "rb") as file:
        data = file.read()
    length = struct.unpack_from("<I", data, 12)[0]
    gltf, start = json.loads(data[20 : 20 + length]), 28 + length

    def accessor(i):
        of = gltf["accessors"][i]
        view = gltf["bufferViews"][of["bufferView"]]
        kind = "<" + {"SCALAR": 1, "VEC3": 3}[of["type"]] * {5126: "f", 5125: "I", 5123: "H", 5121: "B"}[of["componentType"]]
        step = view.get("byteStride", struct.calcsize(kind))
        first = start + view.get("byteOffset", 0) + of.get("byteOffset", 0)
        return [struct.unpack_from(kind, data, first + i * step) for i in range(of["count"])]

    primitive = gltf["meshes"][0]["primitives"][0]
    east, _, south = gltf["nodes"][0]["translation"]
    at = [(x + east, z + south) for x, _, z in accessor(primitive["attributes"]["POSITION"])]
    feature = accessor(primitive["attributes"]["_FEATURE_ID_0"])
    corners = [i[0] for i in accessor(primitive["indices"])]
    return [[at[v] for v in corners[i : i + 3]] for i in range(0, len(corners), 3) if feature[corners[i]][0] < SKIRTS]


def extent(faces):
    """Least and largest in plan."""
    corners = [p for face in faces for p in face]
    return [(min(p[k] for p in corners), max(p[k] for p in corners)) for k in (0, 1)]


def inside(middles, extents):
    return sum(any(all(low <= p[k] < high for k, (low, high) in enumerate(e)) for e in extents) for p in middles)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("program")
    parser.add_argument("source")
    parser.add_argument("--set", action="append", default=[], dest="sets")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temp:
        tiled = os.path.join(temp, "tiled")
        scales = build(args.program, args.source, tiled, args.sets)
        levels = {}
        for level, path, error_m in inner_tiles(tiled):
            faces = triangles(path)
            levels.setdefault(level, []).append((len(faces), extent(faces), error_m))
        with open(os.path.join(tiled, "build.json")) as file:
            most = int(0.7 * json.load(file)["gate"]["faces"])
        least = min(tiles[0][0] for tiles in levels.values())
        steps = []
        while most > least / 2:
            out = os.path.join(temp, str(most))
            scale = build(args.program, args.source, out, args.sets + ONE_CELL + [f"levels.root_faces={most}"])[-1]
            _, path, error_m = inner_tiles(out)[0]
            middles = [tuple(sum(p[k] for p in face) / 3 for k in (0, 1)) for face in triangles(path)]
            if steps and scale <= steps[-1][0]:
                break
            steps.append((scale, middles, error_m))
            most = len(middles) - 1
    print("level  tiles  scale  triangles  uncut  overhead  error m  uncut, at the steps beside it")
    for (level, tiles), scale in zip(sorted(levels.items(), reverse=True), scales):
        total, error_m = sum(t[0] for t in tiles), max(t[2] for t in tiles)
        # The two steps beside it; the first or last two where it lies beyond them.
        later = next((i for i, s in enumerate(steps) if s[0] >= scale), len(steps) - 1)
        beside = steps[max(later, 1) - 1 : max(later, 1) + 1]
        counts = [inside(s[1], [t[1] for t in tiles]) for s in beside]
        (low, high), share = [math.log(s[0]) for s in beside], math.log(scale)
        share = (share - low) / (high - low)
        uncut = math.exp((1 - share) * math.log(counts[0]) + share * math.log(counts[1]))
        errors = ", ".join(f"{s[2]:.3f}" for s in beside)
        row = f"{level:5}  {len(tiles):5}  {scale:5.2f}  {total:9}  {uncut:.0f}  {100 * (total / uncut - 1):6.1f} %"
        print(f"{row}  {error_m:.3f}  {errors}")


if __name__ == "__main__":
    main()
