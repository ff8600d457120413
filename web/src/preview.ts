/** What the camera sees now. */

import { Problem, file, put, type Status } from "./api";
import { choice, field, guarded, h, say } from "./dom";
import { histogram } from "./histogram";

const BINS = 64;
const PAUSE_MS = 150;

const LIGHT: Record<string, [string, string]> = {
  good: ["good", "✓ light is right"],
  over: ["bad", "✗ too bright: shorten the exposure"],
  under: ["warn", "! too dark: lengthen the exposure"],
};

const PICTURES: [string, string][] = [
  ["", "nothing"],
  ["black", "black"],
  ["white", "white"],
  ["h", "H, the brightest"],
  ["v", "V, the darkest"],
  ["focus", "focus"],
  ["crosshair", "crosshair"],
  ["checker", "checker"],
];

function draw(canvas: HTMLCanvasElement, counts: number[]): void {
  const context = canvas.getContext("2d");
  if (!context) return;
  const style = getComputedStyle(canvas);
  const [width, height] = [canvas.width, canvas.height];
  const most = Math.max(1, ...counts.map(Math.sqrt));
  context.clearRect(0, 0, width, height);
  counts.forEach((value, index) => {
    // By roots, so that few saturated pixels are seen.
    const tall = (Math.sqrt(value) / most) * height;
    context.fillStyle = style.getPropertyValue(index === counts.length - 1 ? "--bad" : "--accent");
    context.fillRect((index * width) / counts.length, height - tall, width / counts.length - 1, tall);
  });
}

/** The preview with its histogram; ends with the returned function. */
export function preview(): [HTMLElement, () => void] {
  let running = true;
  const image = h("img", { class: "frame", alt: "What the camera sees; saturated pixels are red", hidden: true });
  const bars = h("canvas", { class: "histogram", width: BINS * 6, height: 56, role: "img", "aria-label": "Histogram of brightness" });
  const light = h("p", { class: "light", role: "status" });
  const none = h("p", { class: "none" }, "Waiting for the camera.");
  const toggle = h("button", { type: "button", "aria-pressed": "true" }, "Pause");
  const show = choice("picture", PICTURES);
  const scratch = document.createElement("canvas");
  show.addEventListener("change", guarded(() => put("/v1/projector", { show: show.value || "black" })));
  let busy = false;
  const whenStatus = (event: Event) => {
    busy = (event as CustomEvent<Status>).detail.state !== "idle";
    if (document.activeElement !== show) show.value = (event as CustomEvent<Status>).detail.showing ?? "";
  };
  document.addEventListener("status", whenStatus);

  async function frame(): Promise<void> {
    const answer = await file("/v1/preview.jpg");
    const share = Number(answer.headers.get("X-Polscan-Saturated-Share") ?? 0);
    const [kind, text] = LIGHT[answer.headers.get("X-Polscan-Exposure") ?? ""] ?? ["plain", ""];
    // A dark picture says nothing of the light while nothing is shown.
    const dark = kind === "warn" && ["", "black"].includes(show.value);
    const address = URL.createObjectURL(await answer.blob());
    const before = image.src;
    image.src = address;
    await image.decode();
    if (before) URL.revokeObjectURL(before);
    image.hidden = false;
    none.hidden = true;
    // While a scan runs, each picture is a pattern; they say nothing of the light one by one.
    if (busy) {
      light.className = "light";
      light.textContent = "";
    } else {
      light.className = dark ? "light" : `light ${kind}`;
      light.textContent = dark ? "The projector is dark: let it hold white to judge the light." : share > 0 ? `${text} (${(100 * share).toFixed(2)} % saturated, red)` : text;
    }
    scratch.width = Math.min(320, image.naturalWidth);
    scratch.height = Math.max(1, Math.round((scratch.width * image.naturalHeight) / image.naturalWidth));
    const context = scratch.getContext("2d", { willReadFrequently: true });
    if (!context) return;
    context.imageSmoothingEnabled = false;
    context.drawImage(image, 0, 0, scratch.width, scratch.height);
    draw(bars, histogram(context.getImageData(0, 0, scratch.width, scratch.height).data, BINS));
  }

  async function look(): Promise<void> {
    while (running) {
      // Somebody who does not look needs no frames; each lights the projector.
      if (!document.hidden && toggle.getAttribute("aria-pressed") === "true") {
        await frame().catch((error) => {
          none.hidden = false;
          none.textContent =
            error instanceof Problem && error.status === 401 ? "Waiting for a token." : error instanceof Error ? error.message : String(error);
        });
      }
      await new Promise((done) => setTimeout(done, PAUSE_MS));
    }
    if (image.src) URL.revokeObjectURL(image.src);
  }
  toggle.addEventListener("click", () => {
    const pressed = toggle.getAttribute("aria-pressed") !== "true";
    toggle.setAttribute("aria-pressed", String(pressed));
    toggle.textContent = pressed ? "Pause" : "Go on";
  });
  look().catch(say);
  const box = h(
    "section",
    { class: "panel preview", "aria-labelledby": "preview-title" },
    h("div", { class: "row spread" }, h("h2", { id: "preview-title" }, "Camera"), toggle, field("Projector holds", show)),
    h("div", { class: "picture" }, image, none),
    h("div", { class: "row" }, bars, light),
  );
  return [
    box,
    () => {
      running = false;
      document.removeEventListener("status", whenStatus);
    },
  ];
}
