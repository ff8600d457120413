/** Level of detail: how many points are drawn while a cloud turns, and in which order. */

/** Fewest points that are drawn; a shape can still be told by them. */
export const FEWEST = 20_000;

/** How long a picture may take while the cloud turns, in milliseconds. */
export const PATIENCE_MS = 40;

/**
 * The numbers 0 to `count` - 1 in an order of which every beginning is an even sample of all of them: by the golden
 * section, with a step that shares no divisor with `count`.
 */
export function spread(count: number): Uint32Array {
  const divisor = (a: number, b: number): number => (b === 0 ? a : divisor(b, a % b));
  let step = Math.max(1, Math.round(count * 0.6180339887498949));
  while (divisor(step, count) > 1) step++;
  const order = new Uint32Array(count);
  for (let index = 0, at = 0; index < count; index++) {
    order[index] = at;
    at += step;
    if (at >= count) at -= count;
    if (at >= count) at %= count;
  }
  return order;
}

/** How many points to draw next, after `drawn` of them took `took_ms`. */
export function budget(drawn: number, took_ms: number, total: number): number {
  const wanted = drawn * (PATIENCE_MS / Math.max(took_ms, 1));
  // Halfway there, so that one slow picture does not make a cloud vanish.
  const next = Math.round((drawn + Math.min(wanted, drawn * 2)) / 2);
  return Math.min(total, Math.max(Math.min(total, FEWEST), next));
}

/** By how much larger points are drawn to cover the same area, where only some are; at most 3. */
export function growth(drawn: number, total: number): number {
  return drawn <= 0 ? 1 : Math.min(3, Math.sqrt(total / drawn));
}
