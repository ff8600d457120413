"""Makes reconstruction/tests/fixtures/partial-area.json: edges that an independent implementation of the partial-area method finds.

The package `subpixel-edges` (PyPI, 0.1.1) finds edge pixels of small images and places the edge in each. Numbers only:
images and what it said of them. Run by hand, outside the project's own environment:

    python -m venv /tmp/reference && /tmp/reference/bin/pip install subpixel-edges==0.1.1 numpy numba
    /tmp/reference/bin/python tests/python/partial_area_reference.py > reconstruction/tests/fixtures/partial-area.json
"""

import json

import numpy as np

# The package asks for a name that numpy has dropped.
np.int = np.int64

from subpixel_edges import subpixel_edges  # noqa: E402

SIDE = 32
OVERSAMPLING = 32


def picture(inside, low, high, noise, seed):
    """Mean of a region's indicator over each pixel, scaled to levels, with noise, in whole levels."""
    fine = (np.arange(SIDE * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    x, y = np.meshgrid(fine, fine)
    share = inside(x, y).reshape(SIDE, OVERSAMPLING, SIDE, OVERSAMPLING).mean(axis=(1, 3))
    levels = low + (high - low) * share
    return np.round(levels + np.random.default_rng(seed).normal(0, noise, levels.shape)).astype(int)


SCENES = {
    "disc": (lambda x, y: (x - 15.3) ** 2 + (y - 16.1) ** 2 < 10.4**2, 300, 3400, 0.0, 1),
    "noisy-disc": (lambda x, y: (x - 15.8) ** 2 + (y - 14.7) ** 2 < 9.2**2, 300, 3400, 60.0, 2),
    "line": (lambda x, y: y - 12.2 > 0.37 * x, 3000, 500, 0.0, 3),
    "steep-line": (lambda x, y: x - 13.7 > 0.21 * y, 100, 3900, 20.0, 4),
}

cases = []
for name, (inside, low, high, noise, seed) in SCENES.items():
    image = picture(inside, low, high, noise, seed)
    for smoothing in (0, 1):
        for order in (1, 2):
            found = subpixel_edges(image.astype(float), 600.0, smoothing, order)
            edges = [
                {"pixel": int(p), "x": float(x), "y": float(y), "nx": float(nx), "ny": float(ny), "levels": [float(a), float(b)]}
                for p, x, y, nx, ny, a, b in zip(
                    found.position, found.x, found.y, found.nx, found.ny, found.i0, found.i1
                )
            ]
            cases.append(
                {"scene": name, "smoothing": smoothing, "order": order, "image": image.ravel().tolist(), "edges": edges}
            )

print(json.dumps({"side": SIDE, "made_by": "subpixel-edges 0.1.1, threshold 600", "cases": cases}))
