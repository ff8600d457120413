/** Brightness of the preview. */

/** The preview paints saturated pixels in this red; JPEG bends it a little. */
function isOverlay(red: number, green: number, blue: number): boolean {
  return red > 140 && green < 110 && blue < 110 && red - green > 70;
}

/** How often each of `bins` steps of brightness is met in an RGBA picture; saturated pixels count as the brightest. */
export function histogram(rgba: ArrayLike<number>, bins: number): number[] {
  const counts = new Array<number>(bins).fill(0);
  for (let at = 0; at + 3 < rgba.length; at += 4) {
    const [red, green, blue] = [rgba[at], rgba[at + 1], rgba[at + 2]];
    const level = isOverlay(red, green, blue) ? 255 : green;
    counts[Math.min(bins - 1, Math.floor((level * bins) / 256))]++;
  }
  return counts;
}
