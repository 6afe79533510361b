#!/usr/bin/env python3
"""Turns a clean labelled building model (OBJ, class per `usemtl`) into a mesh that looks captured.

    remesh_sampled.py IN.obj OUT.ply [--mode skin|subdivide] [--edge 0.5] [--noise 0.03] [--ground] [--seed 1]

skin       the outside of the model as seen from the sky, contoured on a lattice of EDGE metres: closed, rounded at its
           edges, without party walls, floors and interiors. What photogrammetry would make of it.
subdivide  the model's own triangles, every edge split until it is at most EDGE metres long: keeps inner walls,
           undersides and doubled sheets. Conforming: no cracks are added.
--ground   adds a sheet of terrain under and 15 m around the model, at the height of its ground surfaces (or of the
           lowest corner near by), where it has none of its own.
--noise    standard deviation of the noise, metres: two thirds of the variance is correlated over 2 m.

The PLY holds `label` per face: 0 terrain, 1 facade, 2 roof, 3 clutter, -1 not to be judged.
Needs numpy and scipy.
"""
import argparse

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

TERRAIN, FACADE, ROOF, CLUTTER, UNKNOWN, DROP = 0, 1, 2, 3, -1, -2

# The longest fitting beginning of a material's name decides.
NAMES = {
    "Building": ROOF, "BuildingWall": FACADE, "BuildingFloor": DROP, "BuildingPart": ROOF,
    "Terrain": TERRAIN, "Road": TERRAIN, "Water": TERRAIN, "Forest": TERRAIN, "Separation": TERRAIN,
    "LandUse": TERRAIN, "PlantCover": TERRAIN, "Bridge": CLUTTER, "GenericCityObject": UNKNOWN,
    "WallSurface": FACADE, "Window": FACADE, "Door": FACADE, "OuterCeilingSurface": FACADE,
    "RoofSurface": ROOF, "GroundSurface": DROP, "OuterFloorSurface": UNKNOWN, "ClosureSurface": UNKNOWN,
    "Inst_": CLUTTER, "BuildingInstallation": CLUTTER, "none": UNKNOWN,
    "Interior": DROP, "Floor": DROP, "Ceiling": DROP, "BuildingFurniture": DROP,
}


def label_of(name):
    fits = [key for key in NAMES if name.startswith(key)]
    return NAMES[max(fits, key=len)] if fits else UNKNOWN


def read_obj(path):
    vertices, faces, labels, label = [], [], [], UNKNOWN
    with open(path) as lines:
        for line in lines:
            words = line.split()
            if not words:
                continue
            if words[0] == "v":
                vertices.append([float(x) for x in words[1:4]])
            elif words[0] == "usemtl":
                label = label_of(words[1])
            elif words[0] == "f":
                corner = [int(w.split("/")[0]) for w in words[1:]]
                corner = [c - 1 if c > 0 else len(vertices) + c for c in corner]
                for k in range(1, len(corner) - 1):
                    faces.append([corner[0], corner[k], corner[k + 1]])
                    labels.append(label)
    return np.array(vertices), np.array(faces), np.array(labels)


def weld(vertices, faces, labels, at_m=1e-3):
    _, first, back = np.unique(np.round(vertices / at_m).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    faces = back.ravel()[faces]
    good = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return vertices[first], faces[good], labels[good]


def subdivide(vertices, faces, labels, edge_m):
    """Halves every edge that is too long until none is; neighbours split alike."""
    while True:
        pairs = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
        keys = np.sort(pairs, axis=2).reshape(-1, 2)
        edges, back = np.unique(keys, axis=0, return_inverse=True)
        back = back.reshape(-1, 3)
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        long = length > edge_m
        if not long.any():
            return vertices, faces, labels
        middle = np.full(len(edges), -1)
        middle[long] = len(vertices) + np.arange(long.sum())
        vertices = np.vstack([vertices, vertices[edges[long]].mean(axis=1)])
        m = middle[back]
        count = (m >= 0).sum(axis=1)
        out, kinds = [faces[count == 0]], [labels[count == 0]]
        # Turn each triangle so that its pattern starts at corner 0; the longest edges come first with two splits.
        turn = np.zeros(len(faces), int)
        turn[count == 1] = np.argmax(m[count == 1] >= 0, axis=1)
        turn[count == 2] = (np.argmax(m[count == 2] < 0, axis=1) + 1) % 3
        index = (np.arange(3)[None, :] + turn[:, None]) % 3
        f, m = np.take_along_axis(faces, index, 1), np.take_along_axis(m, index, 1)
        (a, b, c), (p, q, r) = f.T, m.T
        for want, triangles in [
            (1, [(a, p, c), (p, b, c)]),
            (2, [(a, p, c), (p, q, c), (p, b, q)]),
            (3, [(a, p, r), (p, b, q), (r, q, c), (p, q, r)]),
        ]:
            for t in triangles:
                out.append(np.stack(t, axis=1)[count == want])
                kinds.append(labels[count == want])
        faces, labels = np.vstack(out), np.concatenate(kinds)


def samples(vertices, faces, labels, spacing_m, random):
    """Points at random over the triangles, about one per squared spacing, and every corner."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    count = np.ceil(2.5 * area / spacing_m**2).astype(int) + 1
    of = np.repeat(np.arange(len(faces)), count)
    u, v = random.random(len(of)), random.random(len(of))
    flip = u + v > 1
    u[flip], v[flip] = 1 - u[flip], 1 - v[flip]
    return a[of] + u[:, None] * (b - a)[of] + v[:, None] * (c - a)[of], labels[of]


def skin(vertices, faces, labels, edge_m, random):
    points, kind = samples(vertices, faces, labels, 0.5 * edge_m, random)
    low = points.min(axis=0) - 3 * edge_m
    shape = np.ceil((points.max(axis=0) + 3 * edge_m - low) / edge_m).astype(int) + 1
    near = np.zeros(shape, bool)
    near[tuple(np.floor((points - low) / edge_m).astype(int).T)] = True
    near = ndimage.binary_dilation(near, np.ones((3, 3, 3), bool), iterations=2)
    tree = cKDTree(points)
    at = np.argwhere(near)
    distance, _ = tree.query(low + at * edge_m, workers=1)
    field = np.full(shape, 2.0 * edge_m, np.float32)
    thick = 0.8 * edge_m
    field[near] = distance - thick
    # What cannot be reached from the sky is inside. Nothing is seen from below: beside the model the sky ends where the
    # nearest column does.
    parts, _ = ndimage.label(field > 0)
    sky = parts == parts[0, 0, -1]
    column = (field <= 0).any(axis=2)
    lowest = np.argmax(field <= 0, axis=2)
    beside = ndimage.distance_transform_edt(~column, return_distances=False, return_indices=True)
    sky &= np.arange(shape[2])[None, None, :] >= lowest[tuple(beside)][:, :, None]
    field = np.where(sky, field, -np.abs(field)).astype(np.float32)
    out_vertices, out_faces = nets(field, sky, column)
    out_vertices = low + out_vertices * edge_m
    centre = out_vertices[out_faces].mean(axis=1)
    _, nearest = tree.query(centre, workers=1)
    return out_vertices, out_faces, kind[nearest]


def nets(field, out, column):
    """Surface nets between `out` and the rest; nothing where no column of the model is near."""
    n = np.array(field.shape)
    cell = {}
    offsets = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    corner = np.stack([out[i : n[0] - 1 + i, j : n[1] - 1 + j, k : n[2] - 1 + k] for i, j, k in offsets], axis=-1)
    mixed = corner.any(axis=-1) & ~corner.all(axis=-1)
    cells = np.argwhere(mixed)
    number = np.full(mixed.shape, -1, np.int64)
    number[mixed] = np.arange(len(cells))
    total, weight = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a in range(8):
        for b in range(a + 1, 8):
            if np.abs(offsets[a] - offsets[b]).sum() != 1:
                continue
            pa, pb = cells + offsets[a], cells + offsets[b]
            fa, fb = field[tuple(pa.T)], field[tuple(pb.T)]
            crosses = out[tuple(pa.T)] != out[tuple(pb.T)]
            span = np.abs(fa) + np.abs(fb) + 1e-9
            t = np.clip(np.abs(fa) / span, 0.02, 0.98)
            point = pa + t[:, None] * (pb - pa)
            total[crosses] += point[crosses]
            weight[crosses] += 1
    vertices = total / np.maximum(weight, 1)[:, None]
    faces = []
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
        first = out[: n[0] - step[0], : n[1] - step[1], : n[2] - step[2]]
        second = out[step[0] :, step[1] :, step[2] :]
        at = np.argwhere(first != second)
        at = at[(at[:, (axis + 1) % 3] > 0) & (at[:, (axis + 2) % 3] > 0)]
        at = at[(at < n - 1).all(axis=1)]
        if axis != 2:
            other = at + step
            at = at[column[at[:, 0], at[:, 1]] | column[other[:, 0], other[:, 1]]]
        else:
            at = at[column[at[:, 0], at[:, 1]]]
        quad = np.stack([number[tuple((at - u - v).T)], number[tuple((at - v).T)], number[tuple(at.T)],
                         number[tuple((at - u).T)]], axis=1)
        # Facing out: from the inside towards the outside.
        inward = out[tuple(at.T)]
        quad[inward] = quad[inward][:, ::-1]
        quad = quad[(quad >= 0).all(axis=1)]
        faces += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    faces = np.vstack(faces)
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def ground_sheet(vertices, faces, labels):
    """Terrain where there is none: squares of a metre at the height of the nearest ground corners."""
    known = faces[np.isin(labels, [DROP, TERRAIN])].ravel()
    points = vertices[known]
    if len(points) == 0:
        points = vertices[faces.ravel()]
    low, high = vertices.min(axis=0) - 15, vertices.max(axis=0) + 15
    nx, ny = (np.ceil(high - low)[:2]).astype(int) + 1
    grid = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), axis=-1).reshape(-1, 2) + low[:2]
    distance, nearest = cKDTree(points[:, :2]).query(grid, k=min(8, len(points)))
    z = np.take(points[:, 2], nearest.reshape(len(grid), -1))
    weight = 1 / (1 + distance.reshape(len(grid), -1)) ** 2
    z = ndimage.gaussian_filter(((z * weight).sum(1) / weight.sum(1)).reshape(nx, ny), 1.5)
    sheet = np.column_stack([grid, z.ravel()])
    i, j = np.meshgrid(np.arange(nx - 1), np.arange(ny - 1), indexing="ij")
    a = (i * ny + j).ravel() + len(vertices)
    squares = np.vstack([np.stack([a, a + ny, a + ny + 1], 1), np.stack([a, a + ny + 1, a + 1], 1)])
    return (np.vstack([vertices, sheet]), np.vstack([faces, squares]),
            np.concatenate([labels, np.full(len(squares), TERRAIN)]))


def noise(vertices, sigma_m, random):
    low = vertices.min(axis=0)
    at = (vertices - low) / 2.0
    shape = np.ceil(at.max(axis=0)).astype(int) + 3
    out = random.normal(0, sigma_m * (1 / 3) ** 0.5, vertices.shape)
    for k in range(3):
        lattice = random.normal(0, 1, shape).astype(np.float32)
        smooth = ndimage.map_coordinates(lattice, at.T, order=1, mode="nearest")
        out[:, k] += smooth / max(smooth.std(), 1e-9) * sigma_m * (2 / 3) ** 0.5
    return vertices + out


def write_ply(path, vertices, faces, labels):
    with open(path, "wb") as out:
        out.write((
            "ply\nformat binary_little_endian 1.0\n"
            "comment label 0 terrain\ncomment label 1 facade\ncomment label 2 roof\ncomment label 3 clutter\n"
            f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
            f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty int label\nend_header\n"
        ).encode())
        out.write(vertices.astype("<f8").tobytes())
        rows = np.zeros(len(faces), dtype=[("n", "u1"), ("f", "<i4", 3), ("label", "<i4")])
        rows["n"], rows["f"], rows["label"] = 3, faces, labels
        out.write(rows.tobytes())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("input")
    parser.add_argument("output")
    parser.add_argument("--mode", choices=["skin", "subdivide"], default="skin")
    parser.add_argument("--edge", type=float, default=0.5)
    parser.add_argument("--noise", type=float, default=0.03)
    parser.add_argument("--ground", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    random = np.random.default_rng(args.seed)
    vertices, faces, labels = read_obj(args.input)
    if args.ground:
        vertices, faces, labels = ground_sheet(vertices, faces, labels)
    keep = labels != DROP
    vertices, faces, labels = weld(vertices, faces[keep], labels[keep])
    if args.mode == "skin":
        vertices, faces, labels = skin(vertices, faces, labels, args.edge, random)
    else:
        vertices, faces, labels = subdivide(vertices, faces, labels, args.edge)
        used, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3)
    vertices = noise(vertices, args.noise, random)
    write_ply(args.output, vertices, faces, labels)
    print(f"{args.output}: {len(vertices)} vertices, {len(faces)} triangles")


if __name__ == "__main__":
    main()
