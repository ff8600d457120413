"""What OpenCV and vectorised numpy need to decode the frames that the measure of decoding speed writes.

    speed.py FOLDER WIDTH HEIGHT COLUMN_BITS ROW_BITS PROJECTOR_WIDTH PROJECTOR_HEIGHT REPEATS

FOLDER holds NN.raw, one byte a sample, in the order bright, dark, then each bit's pattern and inverse from the
coarsest bit on, columns before rows. Prints JSON: least times in ms and the versions. Loading is not counted.
"""

import json
import sys
import time
from pathlib import Path

import cv2
import numpy as np


def least(repeats, work):
    """Least time of some repetitions in ms, and the last result."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        found = work()
        times.append(1e3 * (time.perf_counter() - start))
    return min(times), found


def numpy_decode(bright, dark, frames, bits):
    """Columns, rows and a mask of good pixels; the code is a plain reflected Gray code."""
    modulation = bright.astype(np.int16) - dark
    good = modulation >= 10
    words, at = [], 0
    for count in bits:
        word = np.zeros(bright.shape, np.uint16)
        bit = np.zeros(bright.shape, bool)
        for _ in range(count):
            pattern, inverse = frames[at], frames[at + 1]
            at += 2
            bit ^= pattern > inverse
            good &= np.abs(pattern.astype(np.int16) - inverse) > 2
            word = (word << 1) | bit
        words.append(word)
    return words[0], words[1], good


def main():
    folder = Path(sys.argv[1])
    width, height, column_bits, row_bits, projector_width, projector_height, repeats = map(int, sys.argv[2:9])
    names = sorted(folder.glob("*.raw"))
    planes = [np.fromfile(name, np.uint8).reshape(height, width) for name in names]
    bright, dark, frames = planes[0], planes[1], planes[2:]
    if len(frames) != 2 * (column_bits + row_bits):
        sys.exit(f"speed: {len(frames)} code frames for {column_bits} + {row_bits} bits")
    numpy_ms, (columns, _, good) = least(repeats, lambda: numpy_decode(bright, dark, frames, (column_bits, row_bits)))
    if not good.any() or columns[good].max() >= 1 << column_bits:
        sys.exit("speed: numpy found no code in these frames")

    decoder = cv2.structured_light.GrayCodePattern.create(projector_width, projector_height)
    if decoder.getNumberOfPatternImages() != len(frames):
        sys.exit(f"speed: OpenCV expects {decoder.getNumberOfPatternImages()} code frames, not {len(frames)}")
    # OpenCV decodes two cameras at once; both see the same, and half of the time is one camera's.
    both = lambda: decoder.decode(
        [frames, frames], blackImages=[dark, dark], whiteImages=[bright, bright],
        flags=cv2.structured_light.DECODE_3D_UNDERWORLD,
    )
    opencv_ms, (done, _) = least(max(1, repeats // 2), both)
    if not done:
        sys.exit("speed: OpenCV found no code in these frames")
    print(json.dumps({
        "numpy_ms": numpy_ms, "opencv_ms": opencv_ms / 2,
        "numpy": np.__version__, "opencv": cv2.__version__, "opencv_threads": cv2.getNumThreads(),
    }))


if __name__ == "__main__":
    main()
