/** Calibrations that the service runs, with what they say while they do. */

import { Problem, get, local, post, type Run } from "./api";
import { badge, field, guarded, h, moment, say } from "./dom";
import { current, listen } from "./events";
import { sessionForm, sessionPanel } from "./session";
import { calibrationOutcome, sentences } from "./words";

interface Answer {
  calibrations: { id: string; file: string; kind: string }[];
  runs: Run[];
}

function liveValue(run: Run): HTMLElement | null {
  if (!run.live) return null;
  const most = Math.max(run.live.h_dn, run.live.v_dn, 1);
  const off = run.live.off_deg === null ? "" : `, ${run.live.off_deg.toFixed(1)}° off the darkest V`;
  return h(
    "div",
    { class: "live" },
    h("p", { class: "advice", role: "status" }, sentences(run.live.advice)),
    h("label", {}, `H ${run.live.h_dn.toFixed(0)} DN `, h("meter", { max: most, value: run.live.h_dn })),
    h("label", {}, `V ${run.live.v_dn.toFixed(0)} DN `, h("meter", { max: most, value: Math.max(0, run.live.v_dn) })),
    h("p", { class: "small" }, `${run.live.values} values${off}`),
  );
}

function entry(run: Run, refresh: () => Promise<void>): HTMLElement {
  const [tone, word] = calibrationOutcome(run);
  const going = run.state === "open" || run.state === "running";
  const session = run.session ? sessionPanel(run, run.session, refresh) : null;
  const files = run.artifacts.map((artifact) =>
    h("button", { type: "button", class: "link", onclick: guarded(async () => {
      const link = h("a", { href: await local(artifact.href), download: artifact.name });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
    }) }, artifact.name),
  );
  return h(
    "article",
    { class: "panel", "data-run": run.id },
    h("div", { class: "row spread" }, h("h2", {}, `${run.kind}${run.watch ? ", watching" : ""}`), badge(tone, word), h("span", { class: "small" }, moment(run.created))),
    run.state === "running" && !run.session ? h("p", { role: "status" }, sentences(run.doing ?? "begins")) : null,
    liveValue(run),
    run.error ? h("p", { class: "cause" }, sentences(run.error.message)) : null,
    ...run.refused.map((reason) => h("p", { class: "cause" }, sentences(reason))),
    going ? session : null,
    // While a session goes on its own words say what is missing.
    run.summary.length && !(going && session) ? h("ul", {}, ...run.summary.map((line) => h("li", {}, sentences(line)))) : null,
    going ? null : session,
    files.length ? h("p", { class: "row" }, ...files) : null,
    // A session is closed by its own button alone: to stop one view must not cost those before it.
    run.state === "running" && !run.session
      ? h("button", { type: "button", onclick: guarded(() => post(`${run.href}/cancel`)) }, run.watch ? "Enough" : "Cancel")
      : null,
  );
}

/** The view `#/calibrations`. */
export function calibrations(main: HTMLElement): () => void {
  const runs = new Map<string, Run>();
  const list = h("div", { class: "column" });
  const inUse = h("p", { class: "small" });
  const angle = h("input", { id: "angle", type: "number", min: -360, max: 360, step: "any", placeholder: "not told" });

  const begin = (kind: string, body: unknown) =>
    guarded(async () => {
      const run = await post<Run>(`/v1/calibrations/${kind}`, body);
      take(await current<Run>(run.href));
    });
  const measured = () => (angle.value ? { angle_deg: Number(angle.value) } : {});

  function draw(): void {
    const active = document.activeElement;
    const focused = active?.closest("[data-run]")?.getAttribute("data-run");
    const newest = [...runs.values()].sort((one, other) => (one.id < other.id ? 1 : -1));
    list.replaceChildren(...newest.map((run) => entry(run, () => refresh(run))));
    if (runs.size === 0) list.append(h("p", { class: "none" }, "Nothing was calibrated by this service yet."));
    // The same button of the same run, or none: Enter must not do what another one does.
    const buttons = focused ? list.querySelectorAll<HTMLElement>(`[data-run="${focused}"] button`) : [];
    [...buttons].find((button) => button.textContent === active?.textContent)?.focus();
  }
  async function refresh(run: Run): Promise<void> {
    const found = (await get<Answer>("/v1/calibrations")).runs.find((one) => one.id === run.id);
    if (found) take(await current<Run>(found.href));
    else await load();
  }
  function take(run: Run): void {
    runs.set(run.id, run);
    draw();
  }
  async function load(): Promise<void> {
    const answer = await get<Answer>("/v1/calibrations");
    runs.clear();
    for (const run of answer.runs) runs.set(run.id, run);
    inUse.textContent = answer.calibrations.map((one) => `In use for ${one.kind}: ${one.file} (${one.id.slice(0, 12)})`).join("; ");
    draw();
  }
  const forget = listen((kind, data: Partial<Run> & { id?: string }) => {
    if (kind === "calibration-value" && data.id) {
      const known = runs.get(data.id);
      if (known && data.live) take({ ...known, live: data.live });
    } else if (kind === "calibration" && data.id) {
      current<Run>(`/v1/calibrations/${data.id}`).then(take).catch((error) => {
        // It may have been deleted since; the event of that is on its way.
        if (!(error instanceof Problem && error.status === 404)) say(error);
      });
    } else if (kind === "calibration-deleted" && data.id) {
      runs.delete(data.id);
      draw();
    } else if (kind === "gap") {
      load().catch(say);
    }
  });
  const again = () => void load().catch(() => undefined);
  document.addEventListener("connected", again);
  main.append(
    h("h1", {}, "Calibrations"),
    inUse,
    h(
      "section",
      { class: "panel", "aria-label": "Begin a calibration" },
      h(
        "div",
        { class: "fields" },
        h("button", { type: "button", class: "primary", onclick: begin("noise", {}) }, "Camera noise"),
        h("button", { type: "button", class: "primary", onclick: begin("sync", {}) }, "Projector timing"),
        h("button", { type: "button", class: "primary", onclick: begin("polarization", { watch_s: 600 }) }, "Turn the polarizer"),
        h("button", { type: "button", class: "primary", onclick: () => begin("polarization", measured())() }, "Polarization"),
        field("Polarizer reads (°)", angle),
      ),
      sessionForm((body) => begin("rig", body)),
    ),
    list,
  );
  load().catch(() => undefined);
  return () => {
    forget();
    document.removeEventListener("connected", again);
  };
}
