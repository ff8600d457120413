import "./style.css";
import { token, whenTokenIsAsked, get, type Status } from "./api";
import { calibrations } from "./calibrations";
import { guarded, say } from "./dom";
import { follow, listen, retry, watchConnection, type Connection } from "./events";
import { operate } from "./operate";
import { rig } from "./rig";
import { scanView } from "./scan";

/** A part of the page: puts itself into `main`, and gives back what ends it. */
export type View = (main: HTMLElement, rest: string) => () => void;

const VIEWS: [RegExp, View, string][] = [
  [/^#?\/?$/, operate, "Scan"],
  [/^#\/scans\/([0-9a-f-]+)$/, scanView, "Result"],
  [/^#\/calibrations$/, calibrations, "Calibrations"],
  [/^#\/rig$/, rig, "Rig"],
];

const main = document.getElementById("main") as HTMLElement;
let leave: () => void = () => undefined;

function go(): void {
  leave();
  say();
  main.replaceChildren();
  const found = VIEWS.map(([pattern, view, name]) => [pattern.exec(location.hash), view, name] as const).find(
    ([match]) => match,
  );
  if (!found) {
    location.hash = "#/";
    return;
  }
  const [match, view, name] = found;
  document.title = `${name}: polscan`;
  for (const link of document.querySelectorAll("nav a")) {
    const here = link.getAttribute("href") === (match?.[1] ? "#/" : location.hash || "#/");
    if (here) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  leave = view(main, match?.[1] ?? "");
}

// ------------------------------------------------------------------------------------------------ state of the service

const NAMES: Record<Status["state"], string> = {
  idle: "ready to scan",
  scanning: "scanning",
  calibrating: "calibrating",
  stopping: "the service is ending",
  fault: "cannot scan",
};

const state = document.getElementById("state") as HTMLElement;
let connection: Connection = "connecting";
let asked = 0;

function show(kind: string, text: string, why = ""): void {
  state.className = kind;
  state.textContent = text;
  state.title = why;
}

async function refresh(): Promise<void> {
  const number = ++asked;
  const now = await get<Status>("/v1/status");
  if (number !== asked || connection !== "connected") return;
  const waiting = now.queue.length ? `, ${now.queue.length} waiting` : "";
  const kind = now.state === "fault" ? "bad" : now.state === "idle" ? (now.ready ? "good" : "busy") : "busy";
  const name = now.state === "idle" && !now.ready ? `rig ${now.rig}` : NAMES[now.state];
  show(kind, name + waiting, now.reasons.map((reason) => reason.message).join("\n"));
  document.dispatchEvent(new CustomEvent("status", { detail: now }));
}

let planned = 0;
function refreshSoon(): void {
  clearTimeout(planned);
  planned = window.setTimeout(() => refresh().catch(() => undefined), 60);
}

watchConnection((now) => {
  if (now === "connected") {
    connection = now;
    refreshSoon();
    document.dispatchEvent(new Event("connected"));
    return;
  }
  if (now === "lost") show("bad", "no connection, trying again");
  if (now === "locked") show("bad", "no token");
  // Trying again and again is still no connection.
  connection = now === "connecting" && connection !== "connected" ? connection : now;
});
listen((kind) => {
  if (kind !== "progress" && kind !== "calibration-value") refreshSoon();
});

// ------------------------------------------------------------------------------------------------ token

const login = document.getElementById("login") as HTMLDialogElement;
whenTokenIsAsked((message) => {
  (document.getElementById("login-problem") as HTMLElement).textContent = message;
  if (!login.open) login.showModal();
});
(document.getElementById("login-form") as HTMLFormElement).addEventListener("submit", (event) => {
  event.preventDefault();
  guarded(async () => {
    token.set((document.getElementById("token") as HTMLInputElement).value.trim());
    await get<Status>("/v1/status");
    login.close();
    retry();
    go();
  })();
});

window.addEventListener("hashchange", go);
show("busy", "connecting");
go();
void follow();
