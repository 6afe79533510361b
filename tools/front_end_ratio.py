#!/usr/bin/env python3
"""Prints how much processor time CGAL's front end takes, over ours, for one mesh in one run on this machine.

    front_end_ratio.py PEER.cpp MESH.ply

PEER.cpp  reads `MESH.soup SPACING STAGE...` and prints a JSON line {"stage", "cpu", "n"} per stage: the peers' folder
          has it. It is compiled with g++ against CGAL 5 (Debian: libcgal-dev libeigen3-dev libgmp-dev libmpfr-dev).
MESH.ply  binary little endian, triangles, double or float x y z first, as remesh_sampled.py writes them.

Ours is the bench `front_end` (normals, regions, features, classes; one thread). CGAL's is region growing on mesh faces,
five scales of features on mesh faces, and the raw sum-of-features classification. Skips loudly where CGAL is missing.
"""
import json
import os
import struct
import subprocess
import sys
import tempfile

import numpy as np

HERE = os.path.dirname(os.path.abspath(__file__))


def read_ply(path):
    data = open(path, "rb").read()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode().split("\n")
    kinds = {"double": "<f8", "float": "<f4", "uchar": "u1", "int": "<i4", "uint": "<u4"}
    elements = []
    for line in header:
        words = line.split()
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            if words[1] == "list":
                elements[-1][2].extend([("count", "u1"), ("corners", "<i4", 3)])
            else:
                elements[-1][2].append((words[2], kinds[words[1]]))
    tables = {}
    for name, count, fields in elements:
        tables[name] = np.frombuffer(data, np.dtype(fields), count, end)
        end += tables[name].nbytes
    vertex = tables["vertex"]
    return np.column_stack([vertex["x"], vertex["y"], vertex["z"]]).astype("<f8"), tables["face"]["corners"]


def main():
    peer_source, mesh = sys.argv[1], sys.argv[2]
    vertices, faces = read_ply(mesh)
    with tempfile.TemporaryDirectory() as folder:
        peer = os.path.join(folder, "peer")
        flags = ["-O3", "-DNDEBUG", "-std=c++17", "-I", "/usr/include/eigen3", "-DCGAL_EIGEN3_ENABLED"]
        built = subprocess.run(["g++", *flags, peer_source, "-o", peer, "-lgmp", "-lmpfr", "-lpthread"],
                               capture_output=True, text=True)
        if built.returncode:
            print("SKIPPED: CGAL's front end does not compile here (is libcgal-dev installed?)\n" + built.stderr[:800])
            return
        soup = os.path.join(folder, "mesh.soup")
        with open(soup, "wb") as out:
            out.write(struct.pack("<QQ", len(vertices), len(faces)))
            out.write(vertices.tobytes() + faces.astype("<u4").tobytes())
        edges = vertices[faces] - vertices[np.roll(faces, -1, axis=1)]
        spacing = float(np.median(np.linalg.norm(edges, axis=2)))
        lines = subprocess.run([peer, soup, str(spacing), "rg_mesh", "mesh_feat", "raw"],
                               capture_output=True, text=True, check=True).stdout
        stages = [json.loads(line) for line in lines.splitlines()]
    bench = ["cargo", "bench", "-q", "--bench", "front_end", "--", os.path.abspath(mesh)]
    ours = json.loads(subprocess.run(bench, capture_output=True, text=True, check=True, cwd=HERE).stdout.splitlines()[-1])
    theirs = sum(stage["cpu"] for stage in stages)
    for stage in stages:
        print(f"CGAL {stage['stage']:32} {stage['cpu']:8.2f} s")
    print(f"CGAL in all                           {theirs:8.2f} s, {len(faces) / theirs:10.0f} faces/s")
    print(f"ours                                  {ours['cpu_s']:8.2f} s, {ours['faces_per_s']:10.0f} faces/s")
    print(f"ratio                                 {theirs / ours['cpu_s']:8.1f}")


if __name__ == "__main__":
    main()
