/** The maps of a scan, with the values under the cursor. */

import { bytes } from "./api";
import { choice, field, h } from "./dom";
import { readNpz, type Grid } from "./npz";
import { parula, quantiles } from "./parula";

/** Classes of pixels by number, as `report.json` counts them. */
export const CLASSES = [
  "unlit", "plain", "edge", "inverted", "saturated", "ambiguous", "off boundary", "out of projector", "out of volume",
  "rejected by row", "rejected by vote", "interreflection",
];

const COLOURS = [
  [30, 30, 34], [190, 190, 190], [86, 180, 233], [213, 94, 0], [204, 121, 167], [240, 228, 66], [230, 159, 0],
  [120, 90, 200], [0, 114, 178], [220, 60, 60], [150, 40, 40], [0, 158, 115],
];

const NAMES: Record<string, [string, string]> = {
  depth: ["depth", "mm"],
  column: ["projector column", "px"],
  row: ["projector row", "px"],
  modulation: ["modulation", ""],
  residual: ["residual", "σ"],
  class: ["class", ""],
};

/** The value of a map at a pixel, in words. */
export function valueAt(name: string, grid: Grid, x: number, y: number): string {
  const value = grid.values[y * grid.width + x];
  if (name === "class") return CLASSES[value] ?? String(value);
  if (!Number.isFinite(value)) return "none";
  return `${value.toFixed(Math.abs(value) < 10 ? 3 : 2)} ${NAMES[name]?.[1] ?? ""}`.trim();
}

function paint(canvas: HTMLCanvasElement, name: string, grid: Grid): [number, number] | null {
  canvas.width = grid.width;
  canvas.height = grid.height;
  const context = canvas.getContext("2d");
  if (!context) return null;
  const picture = context.createImageData(grid.width, grid.height);
  const [low, high] = quantiles(grid.values, 0.02, 0.98);
  for (let index = 0; index < grid.values.length; index++) {
    const value = grid.values[index];
    if (name === "class") picture.data.set(COLOURS[value] ?? [0, 0, 0], index * 4);
    else if (Number.isFinite(value)) parula((value - low) / (high - low || 1), picture.data, index * 4);
    else picture.data.set([30, 30, 34], index * 4);
    picture.data[index * 4 + 3] = 255;
  }
  context.putImageData(picture, 0, 0);
  return name === "class" ? null : [low, high];
}

/** Signs of the classes that a map has. */
function classSigns(grid: Grid): HTMLElement[] {
  return [...new Set(grid.values)].sort((a, b) => a - b).map((value) => {
    const sign = h("span", { class: "sign" });
    sign.style.background = `rgb(${(COLOURS[value] ?? [0, 0, 0]).join(",")})`;
    return h("span", { class: "entry" }, sign, CLASSES[value] ?? String(value));
  });
}

/** Maps of the archive at `href`. */
export async function mapsPanel(href: string): Promise<HTMLElement> {
  const grids = readNpz(await bytes(href));
  const names = Object.keys(NAMES).filter((name) => grids.has(name));
  const canvas = h("canvas", { class: "map", tabindex: 0, role: "img", "aria-describedby": "map-value" });
  const value = h("p", { id: "map-value", class: "value", "aria-live": "polite" }, "Point at the map, or move the cursor with the arrow keys.");
  const scale = h("p", { class: "small legend" });
  const which = choice("map", names.map((name) => [name, NAMES[name][0]]), () => show());
  let [x, y] = [0, 0];
  const tell = () => {
    const all = names.map((name) => `${NAMES[name][0]} ${valueAt(name, grids.get(name) as Grid, x, y)}`);
    value.textContent = `(${x}, ${y}): ${all.join(", ")}`;
  };
  function show(): void {
    const grid = grids.get(which.value) as Grid;
    const range = paint(canvas, which.value, grid);
    canvas.setAttribute("aria-label", `Map of ${NAMES[which.value][0]}`);
    const unit = NAMES[which.value][1];
    scale.replaceChildren();
    if (range) scale.textContent = `blue ${range[0].toPrecision(4)} ${unit}, yellow ${range[1].toPrecision(4)} ${unit}`;
    else scale.append(...classSigns(grid));
  }
  const clamp = () => {
    x = Math.min(Math.max(x, 0), canvas.width - 1);
    y = Math.min(Math.max(y, 0), canvas.height - 1);
  };
  canvas.addEventListener("pointermove", (event) => {
    x = Math.floor((event.offsetX / canvas.clientWidth) * canvas.width);
    y = Math.floor((event.offsetY / canvas.clientHeight) * canvas.height);
    clamp();
    tell();
  });
  canvas.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 10 : 1;
    const by: Record<string, [number, number]> = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (!by[event.key]) return;
    event.preventDefault();
    x += by[event.key][0];
    y += by[event.key][1];
    clamp();
    tell();
  });
  show();
  [x, y] = [canvas.width >> 1, canvas.height >> 1];
  return h("div", { class: "maps" }, h("div", { class: "row" }, field("Map", which), scale), canvas, value);
}
