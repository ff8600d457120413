/** How the rig is. */

import { get, type Device, type Status } from "./api";
import { badge, h, say, size } from "./dom";
import { sentences } from "./words";

const words = (name: string) => name.replaceAll("_", " ");

function facts(values: Record<string, unknown> | null): HTMLElement {
  if (!values) return h("p", { class: "none" }, "Not open.");
  const flat = Object.entries(values).flatMap(([name, value]): [string, unknown][] =>
    value !== null && typeof value === "object" ? Object.entries(value).map(([inner, one]): [string, unknown] => [inner, one]) : [[name, value]],
  );
  const number = (value: unknown) => (typeof value === "number" && !Number.isInteger(value) ? value.toFixed(3) : String(value));
  return h("dl", {}, ...flat.flatMap(([name, value]) => [h("dt", {}, words(name)), h("dd", {}, number(value))]));
}

function devices(name: string, found: Device[]): HTMLElement {
  const rows = found.map((device) =>
    h(
      "li",
      {},
      `${device.model}, ${device.serial} (${device.driver}) `,
      device.in_use ? badge("good", "in use") : device.unusable ? badge("warn", "cannot be used") : badge("plain", "free"),
      device.unusable ? h("p", { class: "small" }, sentences(device.unusable)) : null,
    ),
  );
  return h("div", {}, h("h3", {}, name), rows.length ? h("ul", {}, ...rows) : h("p", { class: "none" }, "None was found."));
}

/** The view `#/rig`. */
export function rig(main: HTMLElement): () => void {
  const body = h("div", { class: "rig" });
  const found = h("section", { class: "panel", "aria-labelledby": "devices-title" }, h("h2", { id: "devices-title" }, "Devices"), h("p", {}, "Looking."));
  const show = (status: Status) => {
    const { storage } = status;
    body.replaceChildren(
      h(
        "section",
        { class: "panel", "aria-labelledby": "health-title" },
        h("h2", { id: "health-title" }, "Health"),
        h("p", {}, status.ready ? badge("good", "✓ ready to scan") : badge("bad", "✗ cannot scan"), ` rig ${status.rig}`),
        ...status.reasons.map((reason) => h("p", { class: "cause" }, sentences(reason.message))),
        facts({
          "used by scans": size(storage.used_bytes),
          "free on disk": storage.free_bytes === null ? "not told" : size(storage.free_bytes),
          "most that scans may take": storage.quota_bytes === null ? "no limit" : size(storage.quota_bytes),
          "projector holds": status.showing ?? "nothing",
          version: status.version,
          "running for": `${Math.round(status.uptime_s / 60)} min`,
        }),
      ),
      h("section", { class: "panel", "aria-labelledby": "camera-title" }, h("h2", { id: "camera-title" }, "Camera"), facts(status.camera), facts(status.camera_stream)),
      h("section", { class: "panel", "aria-labelledby": "projector-title" }, h("h2", { id: "projector-title" }, "Projector"), facts(status.projector)),
      found,
    );
  };
  const whenStatus = (event: Event) => show((event as CustomEvent<Status>).detail);
  document.addEventListener("status", whenStatus);
  main.append(h("h1", {}, "Rig"), body);
  get<Status>("/v1/status").then(show).catch(() => undefined);
  get<{ cameras: Device[]; projectors: Device[] }>("/v1/devices")
    .then((answer) => found.replaceChildren(h("h2", { id: "devices-title" }, "Devices"), devices("Cameras", answer.cameras), devices("Projectors", answer.projectors)))
    .catch(say);
  return () => document.removeEventListener("status", whenStatus);
}
