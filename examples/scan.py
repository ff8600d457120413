#!/usr/bin/env python3
"""Asks a running polscan for a scan, waits for it and loads its cloud. Needs nothing but Python itself.

    examples/scan.py [URL] [--mode pse]      POLSCAN_TOKEN holds the token where the service asks for one
"""

import argparse
import array
import json
import os
import sys
import urllib.error
import urllib.request
import uuid


def ask(url, body=None, **headers):
    """Sends a request and returns the body of the answer; a refusal ends the program with its reason."""
    if os.environ.get("POLSCAN_TOKEN"):
        headers["Authorization"] = "Bearer " + os.environ["POLSCAN_TOKEN"]
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, data, {"Content-Type": "application/json", **headers})
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.read()
    except urllib.error.HTTPError as error:
        problem = json.load(error)
        sys.exit(f"refused: {problem['title']}: {problem['detail']}")


def points_mm(ply):
    """x, y, z of every point of a cloud, in millimetres."""
    header, _, data = ply.partition(b"end_header\n")
    lines = header.decode().splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    kinds = [line.split()[1] for line in lines if line.startswith("property")]
    stride = sum({"float": 4, "uchar": 1}[kind] for kind in kinds)
    assert len(data) == count * stride and kinds[:3] == ["float"] * 3
    points = []
    for start in range(0, len(data), stride):
        point = array.array("f", data[start : start + 12])
        if sys.byteorder == "big":
            point.byteswap()
        points.append(tuple(point))
    return points


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("url", nargs="?", default="http://127.0.0.1:8631")
    parser.add_argument("--mode")
    arguments = parser.parse_args()

    wanted = {"label": "bench", "queue": True}
    if arguments.mode:
        wanted["mode"] = arguments.mode
    # Should the connection break, the same key gets the same scan and no second one.
    key = {"Idempotency-Key": str(uuid.uuid4())}
    scan = json.loads(ask(f"{arguments.url}/v1/scans?wait=acquired", wanted, **key))
    print(f"acquired {scan['id']}: the object may move")
    scan = json.loads(ask(f"{arguments.url}{scan['href']}?wait=done"))
    if scan["state"] != "done":
        sys.exit(f"{scan['state']}: " + "; ".join(reason["message"] for reason in scan["reasons"]))
    points = points_mm(ask(f"{arguments.url}{scan['href']}/cloud.ply"))
    nearest, farthest = min(z for _, _, z in points), max(z for _, _, z in points)
    print(f"verdict {scan['verdict']}: {len(points)} points, {nearest:.1f} to {farthest:.1f} mm from the camera")


if __name__ == "__main__":
    main()
