/** The cloud with its tools. */

import { bytes } from "./api";
import type { CloudView, Colouring } from "./cloud";
import { choice, count, field, h, say } from "./dom";
import { steer } from "./keys";
import { COLOURINGS, showLegend } from "./legend";
import { readPly, type Cloud } from "./ply";
import { distance, fitLine, section, type Point, type Profile, type Line } from "./section";

type Tool = "turn" | "distance" | "section";

const TOOLS: [Tool, string][] = [
  ["turn", "turn"],
  ["distance", "measure a distance"],
  ["section", "cut a section"],
];

const HELP: Record<Tool, string> = {
  turn: "Drag to turn, wheel to zoom, right button to move. Keys: arrows, + and −, R.",
  distance: "Point at two places of the cloud. Keys: arrows turn the cloud under the cross, Enter takes the point there.",
  section: "Point at both ends of the section. Keys: arrows turn the cloud under the cross, Enter takes the point there.",
};

function plot(canvas: HTMLCanvasElement, profile: Profile, line: Line | null): void {
  const context = canvas.getContext("2d");
  if (!context || profile.along.length === 0) return;
  const style = getComputedStyle(canvas);
  const [left, right] = [profile.along[0], profile.along[profile.along.length - 1]];
  const near = profile.depth.reduce((least, value) => Math.min(least, value), Infinity);
  const far = profile.depth.reduce((most, value) => Math.max(most, value), -Infinity);
  const [width, height, edge] = [canvas.width, canvas.height, 8];
  const x = (along: number) => edge + ((along - left) / (right - left || 1)) * (width - 2 * edge);
  const y = (depth: number) => edge + ((depth - near) / (far - near || 1)) * (height - 2 * edge);
  context.clearRect(0, 0, width, height);
  context.fillStyle = style.getPropertyValue("--text");
  for (let index = 0; index < profile.along.length; index++) context.fillRect(x(profile.along[index]) - 1, y(profile.depth[index]) - 1, 2, 2);
  if (!line) return;
  context.strokeStyle = style.getPropertyValue("--accent");
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(x(left), y(line.offset + line.slope * left));
  context.lineTo(x(right), y(line.offset + line.slope * right));
  context.stroke();
}

/** The panel of the cloud at `href`; ends with the returned function. */
export function cloudPanel(href: string): [HTMLElement, () => void] {
  const canvas = h("canvas", { class: "cloud", tabindex: 0, "aria-label": "The cloud of points", "aria-describedby": "cloud-help", role: "application" });
  const cross = h("span", { class: "cross", "aria-hidden": "true", hidden: true }, "+");
  const by = choice("colouring", COLOURINGS, () => recolour());
  const tool = choice("tool", TOOLS, () => choose());
  const points = h("input", { id: "point-size", type: "range", min: 1, max: 8, step: 0.5, value: 2, oninput: () => view?.size(Number(points.value)) });
  const thickness = h("input", { id: "thickness", type: "number", min: 0.1, step: 0.1, value: 2, oninput: () => measure() });
  const thick = field("Thickness (mm)", thickness);
  const legend = h("p", { class: "legend" });
  const help = h("p", { id: "cloud-help", class: "small" }, HELP.turn);
  const result = h("p", { class: "result", role: "status" });
  const profile = h("canvas", { class: "profile", width: 720, height: 160, role: "img", "aria-label": "Depth along the section", hidden: true });
  const busy = h("p", { class: "loading" }, "Loading the cloud.");
  const reset = h("button", { type: "button", onclick: () => view?.reset() }, "Reset view");
  const fewer = h("p", { class: "small", id: "cloud-count" });
  const stage = h("div", { class: "stage" }, canvas, cross, busy);
  let view: CloudView | null = null;
  let cloud: Cloud | null = null;
  let marks: Point[] = [];
  let ended = false;

  const recolour = () => view && showLegend(legend, view.colour(by.value as Colouring), by.value as Colouring);
  function choose(): void {
    help.textContent = HELP[tool.value as Tool];
    thick.hidden = tool.value !== "section";
    cross.hidden = tool.value === "turn";
    marks = [];
    measure();
  }
  function measure(): void {
    view?.mark(marks);
    profile.hidden = true;
    result.textContent = marks.length === 1 ? `From (${marks[0].map((value) => value.toFixed(1)).join(", ")}) mm. Now the other end.` : "";
    if (!cloud || marks.length < 2) return;
    const [a, b] = marks;
    if (tool.value === "distance") {
      const parts = [b[0] - a[0], b[1] - a[1], b[2] - a[2]].map((value) => value.toFixed(2));
      result.textContent = `Distance ${distance(a, b).toFixed(2)} mm (x ${parts[0]}, y ${parts[1]}, z ${parts[2]})`;
      return;
    }
    const cut = section(cloud.positions, a, b, Number(thickness.value) || 2);
    const line = fitLine(cut);
    profile.hidden = cut.along.length === 0;
    plot(profile, cut, line);
    result.textContent = line
      ? `Section of ${count(cut.along.length)} points, line fit RMSE ${line.rmse.toFixed(3)} mm, inclination ${((Math.atan(line.slope) * 180) / Math.PI).toFixed(2)}°`
      : "Too few points for a line: make the section thicker or longer.";
  }
  function take(x: number, y: number): void {
    const point = tool.value === "turn" ? null : view?.pointAt(x, y);
    if (tool.value === "turn") return;
    if (!point) {
      result.textContent = "There is no point there.";
      return;
    }
    marks = marks.length >= 2 ? [point] : [...marks, point];
    measure();
  }
  let pressed: [number, number] | null = null;
  canvas.addEventListener("pointerdown", (event) => (pressed = [event.offsetX, event.offsetY]));
  canvas.addEventListener("pointerup", (event) => {
    // A drag turns the cloud; only a press in place points.
    if (pressed && Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) < 4) take(event.offsetX, event.offsetY);
    pressed = null;
  });
  steer(canvas, () => view, { Enter: () => take(canvas.clientWidth / 2, canvas.clientHeight / 2) });

  async function load(): Promise<void> {
    const [data, code] = await Promise.all([bytes(href), import("./cloud")]);
    if (ended) return;
    cloud = readPly(data);
    view = new code.CloudView(canvas, cloud);
    busy.remove();
    fewer.textContent = `${count(cloud.count)} points`;
    recolour();
  }
  choose();
  load().catch((error) => {
    busy.textContent = `The cloud cannot be shown: ${error instanceof Error ? error.message : error}`;
    say(error);
  });
  const box = h(
    "section",
    { class: "panel cloud-panel", "aria-labelledby": "cloud-title" },
    h("div", { class: "row spread" }, h("h2", { id: "cloud-title" }, "Cloud"), fewer),
    h("div", { class: "fields" }, field("Colour by", by), field("Tool", tool), thick, field("Point size", points), reset),
    stage,
    legend,
    result,
    profile,
    help,
  );
  return [
    box,
    () => {
      ended = true;
      view?.dispose();
    },
  ];
}
