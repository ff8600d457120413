/** A cloud by keyboard. */

import type { CloudView } from "./cloud";

/** Turns, zooms and resets what `view` gives, once there is something; `more` are keys of the place that shows it. */
export function steer(canvas: HTMLCanvasElement, view: () => CloudView | null, more: Record<string, () => void> = {}): void {
  const acts: Record<string, () => void> = {
    ArrowLeft: () => view()?.turn(-3, 0),
    ArrowRight: () => view()?.turn(3, 0),
    ArrowUp: () => view()?.turn(0, -3),
    ArrowDown: () => view()?.turn(0, 3),
    "+": () => view()?.zoom(0.9),
    "-": () => view()?.zoom(1.1),
    r: () => view()?.reset(),
    ...more,
  };
  canvas.addEventListener("keydown", (event) => {
    const act = acts[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  });
}
