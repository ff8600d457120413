/** The first page: look, scan, and what was scanned. */

import { Problem, get, post, type Scan, type Status } from "./api";
import { choice, field, guarded, h } from "./dom";
import { current as latest, listen } from "./events";
import { scanList } from "./list";
import { livePanel } from "./live";
import { preview } from "./preview";
import { isOver, outcome } from "./words";

const MODES: [string, string][] = [
  ["", "as configured"],
  ["pse", "pse: accurate"],
  ["fast", "fast: fewer patterns"],
  ["paper", "paper: as published"],
  ["gray", "gray: unpolarized"],
];

/** Where a scan is: bar, words and the button that ends it. */
function progressPanel(): { box: HTMLElement; show: (scan: Partial<Scan>) => void } {
  const bar = h("progress", { max: 1, value: 0, "aria-labelledby": "step" });
  const step = h("p", { id: "step", role: "status" }, "No scan is running.");
  const show = (scan: Partial<Scan>) => {
    if (scan.progress) {
      bar.max = Math.max(1, scan.progress.of);
      bar.value = scan.progress.frames;
    }
    if (scan.progress?.of && (scan.state === undefined || scan.state === "projecting")) {
      const again = scan.progress.retaken ? `, ${scan.progress.retaken} taken again` : "";
      step.textContent = `Pattern ${scan.progress.frames} of ${scan.progress.of}${again}`;
    } else if (scan.state) {
      const words: Partial<Record<Scan["state"], string>> = {
        queued: "Waiting for the rig",
        projecting: "First pattern",
        acquired: "Captured: the object may move now",
        decoding: "Captured: the object may move now. Computing",
      };
      step.textContent = words[scan.state] ?? `Last scan: ${outcome(scan as Scan)[1]}`;
    }
  };
  return { box: h("div", { class: "progress" }, bar, step), show };
}

/** The view `#/`. */
export function operate(main: HTMLElement): () => void {
  const mode = choice("mode", MODES);
  const exposure = h("input", { id: "exposure", type: "number", min: 1, max: 30000000, step: "any", placeholder: "as configured", inputmode: "decimal" });
  const label = h("input", { id: "label", maxlength: 200, autocomplete: "off" });
  const tags = h("input", { id: "tags", autocomplete: "off", placeholder: "separated by commas" });
  const repeat = h("input", { id: "repeat", type: "number", min: 1, max: 1000, placeholder: "1", inputmode: "numeric" });
  const scan = h("button", { id: "scan", class: "primary big", type: "submit" }, "Scan");
  const cancel = h("button", { id: "cancel", class: "big", type: "button", disabled: true }, "Cancel");
  const rest = h("button", { id: "cancel-waiting", type: "button", hidden: true });
  const live = livePanel();
  const { box, show } = progressPanel();
  let current: string | null = null;
  let mine: string | null = null;
  let waiting: string[] = [];

  const form = h(
    "form",
    { class: "panel controls", "aria-label": "Scan" },
    h("div", { class: "row" }, scan, cancel, rest),
    box,
    h("div", { class: "fields" }, field("Mode", mode), field("Exposure (µs)", exposure), field("Label", label), field("Tags", tags), field("How many", repeat)),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    guarded(async () => {
      const body: Record<string, unknown> = { queue: true };
      if (mode.value) body.mode = mode.value;
      if (exposure.value) body.exposure_us = Number(exposure.value);
      if (label.value.trim()) body.label = label.value.trim();
      const names = tags.value.split(",").map((tag) => tag.trim()).filter(Boolean);
      if (names.length) body.tags = names;
      const several = Number(repeat.value) > 1;
      if (several) body.repeat = Number(repeat.value);
      const asked = await post<Scan>("/v1/scans", body);
      show(asked);
      // Of a series each cloud is looked at as it comes; a single scan is opened.
      if (several) return live.follow();
      mine = asked.id;
      // A fast scan may be over before its number is known here.
      settle(await latest<Scan>(`/v1/scans/${mine}`));
    })();
  });
  cancel.addEventListener("click", guarded(async () => {
    if (current) await post(`/v1/scans/${current}/cancel`);
  }));

  rest.addEventListener("click", guarded(async () => {
    // The last first, so that none of them begins meanwhile; one that has come to its end by itself is no fault.
    for (const id of [...waiting].reverse()) {
      await post(`/v1/scans/${id}/cancel`).catch((error) => {
        if (!(error instanceof Problem && [404, 409].includes(error.status))) throw error;
      });
    }
  }));

  /** Opens what the operator asked for, once it is there. */
  function settle(known: Scan): void {
    if (known.id !== mine || !isOver(known)) return;
    mine = null;
    show(known);
    if (known.state === "done" || known.state === "failed") location.hash = `#/scans/${known.id}`;
  }

  const whenStatus = (event: Event) => {
    const status = (event as CustomEvent<Status>).detail;
    current = status.capturing ?? status.queue[0] ?? null;
    cancel.disabled = current === null;
    waiting = status.queue;
    rest.hidden = waiting.length === 0;
    rest.textContent = `Cancel the ${waiting.length} waiting`;
    scan.disabled = status.state === "stopping";
  };
  document.addEventListener("status", whenStatus);
  const forget = listen((kind, data: Scan) => {
    if (kind === "progress") show({ progress: data.progress });
    if (kind === "scan") {
      show(data);
      settle(data);
    }
  });
  const [camera, stop] = preview();
  const [list, end] = scanList();
  main.append(
    h("h1", { class: "unseen" }, "Scan"),
    h("div", { class: "operate" }, h("div", { class: "column" }, camera, live.box), h("div", { class: "column" }, form, list)),
  );
  get<Status>("/v1/status").then((detail) => whenStatus(new CustomEvent("status", { detail }))).catch(() => undefined);
  scan.focus({ preventScroll: true });
  return () => {
    stop();
    end();
    live.end();
    forget();
    document.removeEventListener("status", whenStatus);
  };
}
