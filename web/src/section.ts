/** Geometry of the tools on a cloud: distances, sections and the line through them, points under the pointer. */

export type Point = readonly [number, number, number];

/** Distance of two points. */
export function distance(a: Point, b: Point): number {
  return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}

/** A profile: how far along the section (mm), and how deep (mm). */
export interface Profile {
  along: number[];
  depth: number[];
}

/**
 * What a knife along the camera's axis cuts between `a` and `b`: the points whose distance from the line through both,
 * as the camera sees it (x and y), is at most half of `thickness`, sorted along it.
 */
export function section(positions: Float32Array, a: Point, b: Point, thickness: number): Profile {
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
  const length = Math.hypot(dx, dy);
  const found: [number, number][] = [];
  if (length > 0) {
    const [ux, uy] = [dx / length, dy / length];
    for (let at = 0; at < positions.length; at += 3) {
      const [x, y] = [positions[at] - a[0], positions[at + 1] - a[1]];
      const along = x * ux + y * uy;
      if (along < 0 || along > length || Math.abs(x * uy - y * ux) > thickness / 2) continue;
      found.push([along, positions[at + 2]]);
    }
  }
  found.sort((one, other) => one[0] - other[0]);
  return { along: found.map((one) => one[0]), depth: found.map((one) => one[1]) };
}

/** A line through a profile. */
export interface Line {
  /** Depth over way. */
  slope: number;
  /** Depth at the section's beginning, mm. */
  offset: number;
  /** Root of the mean squared distance of the points from the line, mm. */
  rmse: number;
}

/** The line with the least squared distances, measured at right angles to it; `null` of fewer than 3 points. */
export function fitLine(profile: Profile): Line | null {
  const count = profile.along.length;
  if (count < 3) return null;
  const mean = (values: number[]) => values.reduce((sum, value) => sum + value, 0) / count;
  const [mx, my] = [mean(profile.along), mean(profile.depth)];
  let [xx, xy, yy] = [0, 0, 0];
  for (let index = 0; index < count; index++) {
    const [x, y] = [profile.along[index] - mx, profile.depth[index] - my];
    xx += x * x;
    xy += x * y;
    yy += y * y;
  }
  // The direction of the larger eigenvalue of the scatter; the smaller one is the sum of squared distances.
  const angle = 0.5 * Math.atan2(2 * xy, xx - yy);
  const [sin, cos] = [Math.sin(angle), Math.cos(angle)];
  if (Math.abs(cos) < 1e-9) return null;
  const rest = Math.max(0, sin * sin * xx - 2 * sin * cos * xy + cos * cos * yy);
  const slope = sin / cos;
  return { slope, offset: my - slope * mx, rmse: Math.sqrt(rest / count) };
}

/**
 * Index of the point under the pointer: the nearest to the eye of those within `radius` pixels of it, `-1` where there
 * is none. `matrix` takes a point to the clip space (16 numbers, column by column).
 */
export function pick(
  positions: Float32Array,
  matrix: ArrayLike<number>,
  size: { width: number; height: number },
  pointer: { x: number; y: number },
  radius: number,
): number {
  let [best, nearest] = [-1, Infinity];
  for (let at = 0; at < positions.length; at += 3) {
    const [x, y, z] = [positions[at], positions[at + 1], positions[at + 2]];
    const w = matrix[3] * x + matrix[7] * y + matrix[11] * z + matrix[15];
    if (w <= 0 || w >= nearest) continue;
    const across = ((matrix[0] * x + matrix[4] * y + matrix[8] * z + matrix[12]) / w + 1) * 0.5 * size.width;
    const down = (1 - (matrix[1] * x + matrix[5] * y + matrix[9] * z + matrix[13]) / w) * 0.5 * size.height;
    if (Math.hypot(across - pointer.x, down - pointer.y) > radius) continue;
    [best, nearest] = [at / 3, w];
  }
  return best;
}
