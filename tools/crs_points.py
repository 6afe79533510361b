#!/usr/bin/env python3
"""Writes fixtures/crs_points.json: projected points and where PROJ puts them on the Earth.

Needs pyproj (pip install pyproj); made with pyproj 3.7.2, PROJ 9.5.1, no grid files and no network.

For each system: an origin inside its area of use and points within 5 km of it. The horizontal operation is chosen
explicitly: of PROJ's candidates to WGS 84 the most accurate one without a grid file. Heights are converted to
metres and kept as ellipsoidal heights (PROJ's own pipelines push and pop them around a Helmert step).

    python3 tools/crs_points.py > fixtures/crs_points.json
"""

import json
import math

import pyproj
from pyproj.transformer import AreaOfInterest, Transformer, TransformerGroup

US_FOOT_M = 1200 / 3937

# EPSG code, what it exercises, longitude and latitude of the origin, metres per unit of height.
SYSTEMS = [
    (32631, "UTM north", 2.35, 48.85, 1.0),
    (25832, "UTM on ETRS89, near a zone edge at 60 N", 11.9, 60.2, 1.0),
    (32718, "UTM south", -77.03, -12.05, 1.0),
    (31467, "Gauss-Krueger, Bessel, seven-parameter shift", 8.68, 50.11, 1.0),
    (4547, "CGCS2000 Gauss-Krueger", 114.3, 30.59, 1.0),
    (5186, "Korea 2000", 126.98, 37.57, 1.0),
    (6677, "Japan plane 9, no false easting", 139.75, 35.68, 1.0),
    (2056, "Swiss LV95, oblique Mercator", 7.45, 46.95, 1.0),
    (21781, "Swiss LV03", 8.54, 47.38, 1.0),
    (28992, "Dutch RD, double stereographic", 4.36, 52.01, 1.0),
    (27700, "British National Grid, Airy", -0.12, 51.51, 1.0),
    (2154, "Lambert-93, conformal conic", 2.35, 48.85, 1.0),
    (27572, "Lambert II etendu, Paris meridian, Clarke 1880", 2.35, 48.85, 1.0),
    (2263, "New York Long Island, US survey feet", -73.98, 40.75, US_FOOT_M),
    (2180, "Polish CS92, false northing", 21.01, 52.23, 1.0),
    (3879, "Finland GK25, zone in the easting", 24.94, 60.17, 1.0),
    (2193, "New Zealand TM", 174.76, -36.85, 1.0),
    (5514, "Krovak East North", 14.42, 50.08, 1.0),
    (3844, "Romania Stereo70", 26.1, 44.43, 1.0),
    (2039, "Israel 1993", 34.78, 32.08, 1.0),
    (6991, "Israeli Grid 05/12", 34.78, 32.08, 1.0),
    (5683, "German railways, zone 3", 8.68, 50.11, 1.0),
    (2048, "South African Lo19, westing and southing", 18.9, -33.9, 1.0),
    (3857, "Web Mercator, scale 1.6", 11.58, 48.14, 1.0),
]


def operation(code, lon, lat):
    """The most accurate operation to WGS 84 longitude and latitude that needs no grid."""
    area = AreaOfInterest(lon - 0.01, lat - 0.01, lon + 0.01, lat + 0.01)
    group = TransformerGroup(f"EPSG:{code}", "EPSG:4326", always_xy=True, area_of_interest=area)
    fitting = [t for t in group.transformers if "grid" not in t.definition]
    return fitting[0]


def system(code, what, lon, lat, unit_m):
    chosen = operation(code, lon, lat)
    pipeline = Transformer.from_pipeline("+proj=pipeline " + chosen.definition.removeprefix("proj=pipeline "))
    cart = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
    )
    x, y = chosen.transform(lon, lat, direction="INVERSE")
    linear_m = pyproj.CRS.from_epsg(code).axis_info[0].unit_conversion_factor
    origin = [float(round(x)), float(round(y)), float(round(40 / unit_m))]

    points = []
    for i in range(13):
        # A spiral out to 5 km with heights from -20 m to 300 m; the first point is the origin.
        radius, angle = 5000 * (i / 12) ** 1.5 / linear_m, 2.399963 * i
        dx, dy = round(radius * math.cos(angle), 3), round(radius * math.sin(angle), 3)
        dz = round((0 if i == 0 else -60 + 27.5 * i) / unit_m, 3)
        source = [origin[0] + dx, origin[1] + dy, origin[2] + dz]
        height_m = source[2] * unit_m
        point_lon, point_lat, kept_m = pipeline.transform(source[0], source[1], height_m)
        assert abs(kept_m - height_m) < 1e-6, (code, kept_m, height_m)
        ecef = cart.transform(point_lon, point_lat, height_m)
        points.append({"offset": [dx, dy, dz], "ecef": [round(v, 6) for v in ecef]})
    return {
        "epsg": code,
        "exercises": what,
        "operation": chosen.description,
        "accuracy_m": chosen.accuracy,
        "origin": origin,
        "points": points,
    }


def main():
    pyproj.network.set_network_enabled(False)
    made_with = f"pyproj {pyproj.__version__}, PROJ {pyproj.proj_version_str}"
    systems = [system(*row) for row in SYSTEMS]
    lines = ",\n".join("    " + json.dumps(s) for s in systems)
    print(f'{{\n  "made_with": "{made_with}",\n  "systems": [\n{lines}\n  ]\n}}')


if __name__ == "__main__":
    main()
