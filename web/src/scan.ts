/** One scan: cloud, maps, report, files. */

import { file, get, local, patch, post, remove, type Report, type Scan } from "./api";
import { cloudPanel } from "./cloud_panel";
import { badge, count, guarded, h, moment, say, size } from "./dom";
import { current, listen } from "./events";
import { mapsPanel } from "./maps";
import { causes, coverage, isOver, meaning, outcome, sentences, title } from "./words";

function fileLink(href: string, text: string): HTMLElement {
  // A link sends no token, so that the file is fetched and handed over.
  return h("button", {
    type: "button",
    class: "link",
    onclick: guarded(async () => {
      const link = h("a", { href: await local(href), download: href.split("/").pop() });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
    }),
  }, text);
}

async function picture(href: string, alt: string, caption: string): Promise<HTMLElement> {
  const image = h("img", { src: await local(href), alt });
  return h("figure", {}, image, h("figcaption", {}, caption));
}

async function reportPanel(scan: Scan, report: Report | null): Promise<HTMLElement> {
  const [tone, word] = outcome(scan);
  const has = (name: string) => scan.artifacts.find((artifact) => artifact.name === name);
  const box = h("section", { class: "panel report", "aria-labelledby": "report-title" }, h("h2", { id: "report-title" }, "Report"));
  box.append(h("p", { class: "verdict" }, badge(tone, word), " ", meaning(scan)));
  const found = causes(scan, report);
  for (const cause of found) {
    const numbers = Object.keys(cause.evidence ?? {}).length
      ? h("details", {}, h("summary", {}, "The numbers behind it"), h("pre", { tabindex: 0 }, JSON.stringify(cause.evidence, null, 1)))
      : null;
    box.append(h("article", { class: "cause" }, h("h3", {}, title(cause.type)), h("p", {}, sentences(cause.message)), numbers));
  }
  const evidence = has("maps/worst-pair.png") ?? (found.length ? has("maps/residual.png") : undefined);
  if (evidence && found.length) {
    box.append(await picture(evidence.href, "Residual at each pixel", "The evidence: what does not add up at each pixel, in units of the camera's noise. Yellow is where to look."));
  }
  if (report?.pixels) {
    const share = coverage(report);
    const rows: [string, string][] = [
      ["Points", count(report.points ?? 0)],
      ["Measured", share === null ? "nothing was lit" : `${share.toFixed(1)} % of the lit pixels`],
    ];
    for (const plane of report.planes ?? []) {
      if (plane.rmse_mm !== null) rows.push([`Flatness, ${plane.name}`, `${plane.rmse_mm.toFixed(3)} mm RMS`]);
    }
    box.append(h("dl", {}, ...rows.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)])));
  }
  if (report) {
    for (const note of report.notes) box.append(h("p", { class: "small" }, sentences(note)));
  }
  const summary = has("report.json") ? await (await file(`${scan.href}/summary.txt`)).text() : "";
  if (summary) box.append(h("details", {}, h("summary", {}, "All figures in words"), h("pre", { tabindex: 0 }, summary)));
  return box;
}

function filesPanel(scan: Scan): HTMLElement {
  const rows = scan.artifacts.map((artifact) => h("li", {}, fileLink(artifact.href, artifact.name), ` ${size(artifact.bytes)}`));
  return h(
    "section",
    { class: "panel files", "aria-labelledby": "files-title" },
    h("h2", { id: "files-title" }, "Files"),
    h("p", {}, fileLink(`${scan.href}/bundle.zip`, "everything (bundle.zip)")),
    h("details", {}, h("summary", {}, `${rows.length} files`), h("ul", {}, ...rows)),
  );
}

function editPanel(scan: Scan): HTMLElement {
  const label = h("input", { id: "edit-label", maxlength: 200, value: scan.label ?? "" });
  const tags = h("input", { id: "edit-tags", value: scan.tags.join(", ") });
  const pinned = h("input", { id: "edit-pinned", type: "checkbox", checked: scan.pinned });
  const sure = h("button", { type: "button", class: "bad", hidden: true }, "Delete for ever");
  const form = h(
    "form",
    { class: "fields" },
    h("label", { class: "field" }, h("span", {}, "Label"), label),
    h("label", { class: "field" }, h("span", {}, "Tags"), tags),
    h("label", { class: "check" }, pinned, " keep for ever"),
    h("button", { type: "submit" }, "Save"),
    h("button", { type: "button", onclick: guarded(async () => {
      const again = await post<Scan>(`${scan.href}/reprocess`);
      location.hash = `#/scans/${again.id}`;
    }) }, "Decode again"),
    h("button", { type: "button", onclick: () => (sure.hidden = !sure.hidden) }, "Delete"),
    sure,
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    guarded(() => patch(scan.href, {
      label: label.value.trim() || null,
      tags: tags.value.split(",").map((tag) => tag.trim()).filter(Boolean),
      pinned: pinned.checked,
    }))();
  });
  sure.addEventListener("click", guarded(async () => {
    await remove(scan.href);
    location.hash = "#/";
  }));
  return h("section", { class: "panel", "aria-labelledby": "edit-title" }, h("h2", { id: "edit-title" }, "This scan"), form);
}

/** The view `#/scans/ID`. */
export function scanView(main: HTMLElement, id: string): () => void {
  let ended = false;
  let shown = false;
  let revision = -1;
  let dispose: () => void = () => undefined;
  const heading = h("h1", {}, "Scan");
  const body = h("div", { class: "scan-view" }, h("p", {}, "Loading."));
  main.append(h("div", { class: "row" }, h("a", { href: "#/", class: "back" }, "← Scans"), heading), body);

  async function fill(scan: Scan): Promise<void> {
    const has = (name: string) => scan.artifacts.find((artifact) => artifact.name === name);
    const report = has("report.json") ? await get<Report>(`${scan.href}/report.json`) : null;
    const words = await reportPanel(scan, report);
    if (ended) return;
    const [cloud, maps] = [has("cloud.ply"), has("maps.npz")];
    const side = h("div", { class: "column" }, editPanel(scan), filesPanel(scan));
    const wide = h("div", { class: "column" });
    // Without a result to look at, the report is what there is to see.
    if ((cloud && scan.points) || maps) side.prepend(words);
    else wide.append(words);
    body.replaceChildren(wide, side);
    if (cloud && scan.points) {
      const [panel, end] = cloudPanel(cloud.href);
      wide.append(panel);
      dispose = end;
    }
    if (ended) dispose();
    if (maps) {
      const holder = h("section", { class: "panel", "aria-labelledby": "maps-title" }, h("h2", { id: "maps-title" }, "Maps"));
      wide.append(holder);
      // A report is worth reading where the maps are damaged as well.
      holder.append(await mapsPanel(maps.href).catch((error) => h("p", { class: "none" }, sentences(`the maps cannot be shown: ${error.message}`))));
    }
  }

  async function load(): Promise<void> {
    const scan = await current<Scan>(`/v1/scans/${id}`);
    // Answers may overtake each other.
    if (ended || shown || scan.revision < revision) return;
    revision = scan.revision;
    heading.textContent = scan.label ?? moment(scan.created);
    document.title = `${heading.textContent}: polscan`;
    if (!isOver(scan)) {
      body.replaceChildren(h("p", { role: "status" }, `This scan is ${outcome(scan)[1]}: ${scan.progress.frames} of ${scan.progress.of || "?"} patterns.`));
      return;
    }
    shown = true;
    await fill(scan);
  }
  const forget = listen((kind, data) => {
    if ((kind === "scan" || kind === "progress") && data.id === id && !shown) load().catch(say);
  });
  load().catch((error) => {
    say(error);
    body.replaceChildren();
  });
  return () => {
    ended = true;
    forget();
    dispose();
  };
}
