/** Colours for values: dark blue is small, yellow is large, and lightness grows all the way. */

/** Support points of the map, evenly spaced, in sRGB bytes; between them it is linear. */
const STOPS: readonly (readonly [number, number, number])[] = [
  [62, 38, 168],
  [71, 75, 235],
  [50, 123, 252],
  [38, 156, 232],
  [18, 177, 209],
  [32, 194, 165],
  [85, 204, 112],
  [170, 199, 57],
  [236, 186, 60],
  [250, 214, 44],
  [249, 251, 21],
];

/** Writes the colour of `share` (0 to 1, clamped; not a number is grey) into three bytes of `out` from `at` on. */
export function parula(share: number, out: Uint8Array | Uint8ClampedArray, at: number): void {
  if (Number.isNaN(share)) {
    out[at] = out[at + 1] = out[at + 2] = 96;
    return;
  }
  const place = Math.min(Math.max(share, 0), 1) * (STOPS.length - 1);
  const index = Math.min(Math.floor(place), STOPS.length - 2);
  const rest = place - index;
  for (let channel = 0; channel < 3; channel++) {
    const low = STOPS[index][channel];
    out[at + channel] = Math.round(low + (STOPS[index + 1][channel] - low) * rest);
  }
}

/** The values below which `low` and `high` (shares) of the finite values lie, from at most 50 000 evenly picked ones. */
export function quantiles(values: ArrayLike<number>, low: number, high: number): [number, number] {
  const step = Math.max(1, Math.floor(values.length / 50000));
  const picked: number[] = [];
  for (let index = 0; index < values.length; index += step) {
    if (Number.isFinite(values[index])) picked.push(values[index]);
  }
  if (picked.length === 0) return [0, 1];
  picked.sort((a, b) => a - b);
  const at = (share: number) => picked[Math.round(share * (picked.length - 1))];
  return [at(low), at(high)];
}
