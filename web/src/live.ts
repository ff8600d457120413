/** The cloud of the latest scan as soon as it is there, for whoever asked for it: a series, a script, somebody else. */

import { bytes, get, type Scan } from "./api";
import type { CloudView, Colouring } from "./cloud";
import { badge, choice, count, field, h, moment } from "./dom";
import { listen } from "./events";
import { steer } from "./keys";
import { COLOURINGS, showLegend } from "./legend";
import { readPly } from "./ply";
import { isOver, outcome } from "./words";

/** Points of a picture that comes often: 1.5 MB. */
const POINTS = 50_000;

/** Events tell what a scan is, but not where. */
const address = (scan: Scan): string => `/v1/scans/${scan.id}`;

/** The panel; `follow` opens it, and `end` ends it. While it is closed nothing is fetched. */
export function livePanel(): { box: HTMLElement; follow: () => void; end: () => void } {
  const canvas = h("canvas", { class: "cloud", id: "live-cloud", tabindex: 0, "aria-label": "The cloud of the latest scan", role: "application" });
  const about = h("p", { class: "small", id: "live-about", role: "status" }, "The next scan is shown here.");
  const failed = h("p", { class: "small", id: "live-failed", role: "status" });
  const legend = h("p", { class: "legend" });
  const by = choice("live-colouring", COLOURINGS, () => recolour());
  const stage = h("div", { class: "stage" }, canvas);
  const box = h(
    "details",
    { class: "panel live" },
    h("summary", {}, h("h2", {}, "Latest cloud")),
    h("div", { class: "row spread" }, about, field("Colour by", by)),
    stage,
    legend,
    failed,
  );
  let view: CloudView | null = null;
  let wanted: Scan | null = null;
  let shown = "";
  let busy = false;
  let ended = false;
  const recolour = () => view && showLegend(legend, view.colour(by.value as Colouring), by.value as Colouring);

  async function show(scan: Scan): Promise<void> {
    const [data, code] = await Promise.all([bytes(`${address(scan)}/sample.ply?points=${POINTS}`), import("./cloud")]);
    if (ended) return;
    const cloud = readPly(data);
    if (view) view.replace(cloud);
    else view = new code.CloudView(canvas, cloud, false);
    recolour();
    shown = scan.id;
    const [tone, word] = outcome(scan);
    const points = `${count(cloud.count)} of ${count(scan.points ?? cloud.count)} points`;
    about.replaceChildren(badge(tone, word), " ", h("a", { href: `#/scans/${scan.id}` }, scan.label ?? moment(scan.created)), `, ${points}`);
    failed.textContent = "";
    box.dataset.shown = scan.id;
  }

  /** Shows what is wanted; where scans come faster than they can be shown, those between are left out. */
  async function pump(): Promise<void> {
    if (busy) return;
    busy = true;
    for (let scan = wanted; box.open && !ended && scan && scan.id !== shown; scan = wanted === scan ? null : wanted) {
      await show(scan).catch((error) => {
        failed.textContent = `This cloud cannot be shown: ${error instanceof Error ? error.message : error}`;
      });
    }
    busy = false;
  }

  function take(scan: Scan): void {
    // What is told of an older one is a new label, or that it is kept. Identities begin with the time.
    if (wanted && scan.id < wanted.id) return;
    if (scan.points) {
      wanted = scan;
      void pump();
    } else if (scan.state === "failed") {
      failed.replaceChildren(badge(...outcome(scan)), " ", h("a", { href: `#/scans/${scan.id}` }, "The latest scan"), " has no cloud. Above is one before.");
    }
  }

  /** What was there before somebody looked. */
  async function latest(): Promise<void> {
    const { scans } = await get<{ scans: Scan[] }>("/v1/scans?state=done&limit=1");
    if (!wanted && scans.length) take(scans[0]);
  }

  box.addEventListener("toggle", () => {
    if (!box.open) return;
    if (wanted) void pump();
    else latest().catch(() => undefined);
  });
  steer(canvas, () => view);
  const forget = listen((kind, data: Scan) => {
    if (kind === "scan" && isOver(data)) take(data);
  });
  return {
    box,
    follow: () => {
      box.open = true;
      box.scrollIntoView({ block: "nearest" });
    },
    end: () => {
      ended = true;
      forget();
      view?.dispose();
    },
  };
}
