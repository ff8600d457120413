/** What the colours of a cloud mean. */

import type { Colouring, Legend } from "./cloud";
import { h } from "./dom";

/** What a person may choose. */
export const COLOURINGS: [Colouring, string][] = [
  ["depth", "depth"],
  ["sigma", "uncertainty (σ)"],
  ["class", "class"],
  ["intensity", "brightness"],
];

/** Shows the scale of a colouring in `box`. */
export function showLegend(box: HTMLElement, legend: Legend, by: Colouring): void {
  box.replaceChildren();
  if (!legend) return;
  if ("names" in legend) {
    for (const [name, colour] of legend.names) {
      const sign = h("span", { class: "sign" });
      sign.style.background = colour;
      box.append(h("span", { class: "entry" }, sign, name));
    }
    return;
  }
  const unit = by === "intensity" ? "" : " mm";
  const digits = by === "sigma" ? 3 : by === "depth" ? 1 : 0;
  box.append(h("span", {}, `${legend.low.toFixed(digits)}${unit}`), h("span", { class: by === "intensity" ? "bar grey" : "bar" }), h("span", {}, `${legend.high.toFixed(digits)}${unit}`));
}
