/** What was scanned, the newest first. */

import { get, local, type Scan } from "./api";
import { badge, choice, count, field, guarded, h, moment, say } from "./dom";
import { isStale, listen } from "./events";
import { outcome } from "./words";

const LIMIT = 12;

const VERDICTS: [string, string][] = [
  ["", "all"],
  ["verdict=ok", "ok"],
  ["verdict=degraded", "degraded"],
  ["verdict=failed", "failed"],
  ["state=cancelled", "cancelled"],
];

interface Page {
  scans: Scan[];
  next: string | null;
}

/** Small pictures of clouds by scan; kept while the page lives, so that a change of the list loads none twice. */
const thumbnails = new Map<string, Promise<string>>();
const MOST_THUMBNAILS = 100;

function thumbnail(scan: Scan): HTMLElement {
  const image = h("img", { class: "thumb", alt: "", width: 96, height: 72 });
  if (!scan.points) return h("span", { class: "thumb" });
  let address = thumbnails.get(scan.id);
  if (!address) {
    address = local(`${scan.href}/cloud.png`);
    thumbnails.set(scan.id, address);
    for (const [id, old] of thumbnails) {
      if (thumbnails.size <= MOST_THUMBNAILS) break;
      thumbnails.delete(id);
      old.then(URL.revokeObjectURL, () => undefined);
    }
  }
  address.then((source) => (image.src = source)).catch(() => thumbnails.delete(scan.id));
  return image;
}

function row(scan: Scan, byTag: (tag: string) => void): HTMLElement {
  const [tone, word] = outcome(scan);
  const reason = scan.reasons[0] ?? scan.error;
  return h(
    "li",
    {},
    h(
      "a",
      { href: `#/scans/${scan.id}`, class: "scan", "data-scan": scan.id },
      thumbnail(scan),
      h(
        "span",
        { class: "about" },
        h("strong", {}, scan.label ?? moment(scan.created)),
        h("span", { class: "small" }, `${scan.label ? `${moment(scan.created)}, ` : ""}${scan.mode}${scan.points ? `, ${count(scan.points)} points` : ""}`),
        reason ? h("span", { class: "small" }, reason.type) : null,
      ),
      badge(tone, word),
    ),
    scan.tags.length
      ? h("p", { class: "tags" }, ...scan.tags.map((tag) => h("button", { type: "button", class: "tag", onclick: () => byTag(tag) }, tag)))
      : null,
  );
}

/** The list with filter and pages; ends with the returned function. */
export function scanList(): [HTMLElement, () => void] {
  const list = h("ul", { class: "scans" });
  const verdict = choice("filter-verdict", VERDICTS, () => renew());
  const label = h("input", { id: "filter-label", type: "search", oninput: () => soon() });
  const tag = h("input", { id: "filter-tag", type: "search", oninput: () => soon() });
  const newer = h("button", { type: "button", disabled: true }, "Newer");
  const older = h("button", { type: "button", disabled: true }, "Older");
  /** Cursors of the pages before this one and of this one. */
  let cursors: string[] = [""];
  let next: string | null = null;
  let asked = 0;
  let planned = 0;

  async function load(): Promise<void> {
    const number = ++asked;
    const query = new URLSearchParams(verdict.value);
    query.set("limit", String(LIMIT));
    if (label.value.trim()) query.set("label", label.value.trim());
    if (tag.value.trim()) query.set("tag", tag.value.trim());
    const cursor = cursors[cursors.length - 1];
    if (cursor) query.set("cursor", cursor);
    const page = await get<Page>(`/v1/scans?${query}`);
    if (number !== asked) return;
    next = page.next;
    if (page.scans.some(isStale)) refresh();
    older.disabled = next === null;
    newer.disabled = cursors.length === 1;
    const focused = document.activeElement?.getAttribute("data-scan");
    list.replaceChildren(
      ...page.scans.map((scan) =>
        row(scan, (name) => {
          tag.value = name;
          renew();
        }),
      ),
    );
    if (page.scans.length === 0) list.append(h("li", { class: "none" }, query.size > 1 ? "No scan fits." : "Nothing was scanned yet. Press Scan."));
    if (focused) list.querySelector<HTMLElement>(`[data-scan="${focused}"]`)?.focus();
  }
  const renew = () => {
    cursors = [""];
    load().catch(say);
  };
  const soon = () => {
    clearTimeout(planned);
    planned = window.setTimeout(() => renew(), 250);
  };
  const refresh = () => {
    clearTimeout(planned);
    planned = window.setTimeout(() => load().catch(() => undefined), 80);
  };
  older.addEventListener("click", guarded(() => {
    if (next) cursors.push(next);
    return load();
  }));
  newer.addEventListener("click", guarded(() => {
    if (cursors.length > 1) cursors.pop();
    return load();
  }));
  const forget = listen((kind) => {
    if (["scan", "deleted", "gap"].includes(kind)) refresh();
  });
  document.addEventListener("connected", refresh);
  load().catch(() => undefined);
  const box = h(
    "section",
    { class: "panel list", "aria-labelledby": "scans-title" },
    h("h2", { id: "scans-title" }, "Scans"),
    h("div", { class: "fields", role: "search" }, field("Verdict", verdict), field("Label", label), field("Tag", tag)),
    list,
    h("div", { class: "row" }, newer, older),
  );
  return [
    box,
    () => {
      forget();
      clearTimeout(planned);
      document.removeEventListener("connected", refresh);
    },
  ];
}
