/** Calibration of the rig with a board: opening a session, and what to do next in it. */

import { post, remove, type Run, type Session, type SessionView } from "./api";
import { choice, field, guarded, h } from "./dom";
import { sentences } from "./words";

const ROWS = ["top", "middle", "bottom"];
const COLUMNS = ["left", "middle", "right"];

/** Ninths of a picture with what was found in each, as a table that can be read without seeing it. */
function coverage(name: string, ninths: number[][]): HTMLElement {
  const rows = ninths.map((row, y) =>
    h("tr", {}, h("th", { scope: "row" }, ROWS[y]), ...row.map((found) => h("td", { class: found > 0 ? "covered" : "bare" }, found > 0 ? `✓ ${found}` : "none"))),
  );
  const head = h("tr", {}, h("td", {}), ...COLUMNS.map((column) => h("th", { scope: "col" }, column)));
  return h("table", { class: "coverage" }, h("caption", {}, name), h("thead", {}, head), h("tbody", {}, ...rows));
}

const degrees = (value: number): string => `${value < 0 ? "−" : ""}${Math.abs(value).toFixed(0)}°`;

/** A view in a line. */
export function viewInWords(view: SessionView): string {
  if (view.unusable) return sentences(view.unusable);
  const sharp = view.corner_sigma_px === null ? "" : `, known to ${view.corner_sigma_px.toFixed(3)} px`;
  const tilt = view.tilt_deg ? `, tilted by ${view.tilt_deg.map(degrees).join(" and ")}` : "";
  return `${view.corners} corners${sharp}${tilt}.`;
}

/** What the operator should do now. */
export function nextStep(session: Session): string {
  if (session.missing.length > 0) return `Next: ${session.missing[0]}`;
  if (session.views_missing > 0) {
    return `Next: ${session.views_missing} more ${session.views_missing === 1 ? "view" : "views"}, each with the board elsewhere`;
  }
  return "Nothing is missing: calibrate";
}

/** A session as it stands; `refresh` is called after each request. */
export function sessionPanel(run: Run, session: Session, refresh: () => Promise<void>): HTMLElement {
  const busy = run.state === "running";
  const over = !busy && run.state !== "open";
  const step = (path: string) => guarded(async () => {
    await post(`${run.href}/${path}`);
    await refresh();
  });
  const views = session.views.map((view) =>
    h(
      "li",
      { "data-view": view.name, class: view.unusable ? "bad" : null },
      h("strong", {}, view.name),
      ` ${viewInWords(view)} `,
      over ? null : h("button", { type: "button", class: "link", disabled: busy, onclick: guarded(async () => {
        await remove(`${run.href}/views/${encodeURIComponent(view.name)}`);
        await refresh();
      }) }, `Drop ${view.name}`),
    ),
  );
  const more = session.missing.slice(1);
  return h(
    "div",
    { class: "session" },
    h("p", { class: "small" }, sentences(session.board)),
    over ? null : h("p", { class: "advice", role: "status" }, busy ? sentences(run.doing ?? "begins") : sentences(nextStep(session))),
    more.length && !over ? h("details", {}, h("summary", {}, `and ${more.length} more`), h("ul", {}, ...more.map((one) => h("li", {}, sentences(one))))) : null,
    over
      ? null
      : h(
          "div",
          { class: "row" },
          h("button", { type: "button", class: "primary", disabled: busy, onclick: step("views") }, "Take a view"),
          h("button", { type: "button", class: session.missing.length ? null : "primary", disabled: busy || session.views.length === 0, onclick: step("solve") }, "Calibrate"),
          h("button", { type: "button", class: "bad", disabled: busy, onclick: guarded(async () => {
            await post(`${run.href}/cancel`);
            await remove(run.href);
            await refresh();
          }) }, "Give up and delete"),
        ),
    h("div", { class: "row" }, coverage("Corners in the camera's image", session.camera_coverage), coverage("Points in the projector's picture", session.projector_coverage)),
    h("p", {}, session.views.length === 1 ? "1 view" : `${session.views.length} views`),
    h("ul", { class: "views" }, ...views),
  );
}

const number = (id: string, value: string, more: Record<string, unknown> = {}): HTMLInputElement =>
  h("input", { id, type: "number", min: 0, step: "any", required: true, value, ...more });

/** Fields that describe a board, and the button that opens a session with it. */
export function sessionForm(open: (body: unknown) => () => void): HTMLElement {
  const columns = number("board-columns", "9", { step: 1, min: 2 });
  const rows = number("board-rows", "6", { step: 1, min: 2 });
  const pitch = number("board-pitch", "18");
  const inner = number("board-inner", "13.5");
  const dictionary = choice("board-dictionary", ["4x4", "5x5", "6x6", "7x7"].map((name) => [name, name]));
  const measured = h("input", { id: "board-bar", type: "number", min: 0, step: "any", placeholder: "not measured" });
  const baseline = h("input", { id: "board-baseline", type: "number", min: 0, step: "any", placeholder: "not measured" });
  const staggered = h("input", { id: "board-staggered", type: "checkbox" });
  const staggeredField = h("label", { class: "check" }, staggered, " every second row shifted");
  const innerField = field("Marker (mm)", inner);
  const dictionaryField = field("Markers", dictionary);
  const pitchName = field("Square (mm)", pitch);
  const kind = choice(
    "board-kind",
    [["checkerboard", "checkerboard"], ["charuco", "ChArUco"], ["circles", "circles"]],
    () => shape(),
  );
  function shape(): void {
    innerField.hidden = kind.value === "checkerboard";
    staggeredField.hidden = kind.value !== "circles";
    dictionaryField.hidden = kind.value !== "charuco";
    const [label] = innerField.getElementsByTagName("span");
    label.textContent = kind.value === "circles" ? "Diameter (mm)" : "Marker (mm)";
    const [distance] = pitchName.getElementsByTagName("span");
    distance.textContent = kind.value === "circles" ? "Distance (mm)" : "Square (mm)";
    inner.disabled = kind.value === "checkerboard";
  }
  const size = () => ({ columns: Number(columns.value), rows: Number(rows.value) });
  function pattern(): Record<string, unknown> {
    const [square_mm, other] = [Number(pitch.value), Number(inner.value)];
    if (kind.value === "charuco") return { charuco: { ...size(), square_mm, marker_mm: other, dictionary: dictionary.value } };
    if (kind.value === "circles") return { circles: { ...size(), pitch_mm: square_mm, diameter_mm: other, asymmetric: staggered.checked } };
    return { checkerboard: { ...size(), square_mm } };
  }
  const optional = (name: string, input: HTMLInputElement) => (input.value ? { [name]: Number(input.value) } : {});
  const form = h(
    "form",
    { class: "fields", "aria-label": "A session with a board" },
    field("Board", kind),
    field("Columns", columns),
    field("Rows", rows),
    pitchName,
    innerField,
    dictionaryField,
    staggeredField,
    field("Printed bar measures (mm)", measured),
    field("Camera to projector (mm)", baseline),
    h("button", { type: "submit", class: "primary" }, "Rig, with a board"),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    open({ board: { pattern: pattern() }, ...optional("measured_mm", measured), ...optional("baseline_mm", baseline) })();
  });
  shape();
  return form;
}
