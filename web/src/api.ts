/** What the service answers, and how it is asked. */

export interface Cause {
  type: string;
  message: string;
  evidence?: Record<string, unknown>;
}

export interface Progress {
  frames: number;
  of: number;
  retaken: number;
}

export interface Artifact {
  name: string;
  href: string;
  bytes: number;
}

export interface Scan {
  id: string;
  state: "queued" | "projecting" | "acquired" | "decoding" | "done" | "failed" | "cancelled" | "interrupted";
  revision: number;
  mode: string;
  label: string | null;
  tags: string[];
  pinned: boolean;
  created: string;
  progress: Progress;
  held: boolean;
  verdict: "ok" | "degraded" | "failed" | null;
  reasons: Cause[];
  error: Cause | null;
  points: number | null;
  bytes: number | null;
  href: string;
  artifacts: Artifact[];
}

export interface Status {
  ready: boolean;
  reasons: Cause[];
  state: "idle" | "scanning" | "calibrating" | "stopping" | "fault";
  capturing: string | null;
  calibrating: string | null;
  finishing: string[];
  queue: string[];
  held: number;
  rig: string;
  rig_message: string | null;
  camera: Record<string, unknown> | null;
  projector: Record<string, unknown> | null;
  camera_stream: Record<string, number>;
  showing: string | null;
  storage: { free_bytes: number | null; used_bytes: number; quota_bytes: number | null };
  version: string;
  uptime_s: number;
}

export interface Device {
  driver: string;
  model: string;
  serial: string;
  unusable: string | null;
  in_use: boolean;
}

/** A view of the board in a session. */
export interface SessionView {
  name: string;
  corners: number;
  plane_points: number;
  corner_sigma_px: number | null;
  tilt_deg: number[] | null;
  unusable: string | null;
}

/** A session with a board as it stands. */
export interface Session {
  board: string;
  views: SessionView[];
  missing: string[];
  views_missing: number;
  camera_coverage: number[][];
  projector_coverage: number[][];
}

export interface Run {
  id: string;
  revision: number;
  kind: string;
  state: "open" | "running" | "done" | "failed" | "cancelled" | "interrupted";
  created: string;
  steps: number;
  doing: string | null;
  watch: boolean;
  accepted: boolean | null;
  refused: string[];
  summary: string[];
  error: Cause | null;
  session: Session | null;
  live: { h_dn: number; v_dn: number; off_deg: number | null; advice: string; values: number } | null;
  href: string;
  artifacts: { name: string; href: string }[];
}

/** The parts of `report.json` that the page tells. */
export interface Report {
  verdict: string;
  reasons: Cause[];
  notes: string[];
  simulated: boolean;
  /** `null` where the capture did not come to its end. */
  pixels: Record<string, number> | null;
  points: number | null;
  planes?: { name: string; points: number; rmse_mm: number | null; bow_mm: number | null }[];
}

/** An answer that is an error: a problem document, or no answer at all. */
export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly type: string,
    message: string,
  ) {
    super(message);
  }
}

const TOKEN = "polscan-token";

/** The token of this browser tab, empty where there is none. */
export const token = {
  get: () => sessionStorage.getItem(TOKEN) ?? "",
  set: (value: string) => sessionStorage.setItem(TOKEN, value),
};

/** Who wants to know that the service asks for a token. */
let askForToken: (message: string) => void = () => undefined;

export function whenTokenIsAsked(act: (message: string) => void): void {
  askForToken = act;
}

/** Headers of every request. */
export function headers(more: Record<string, string> = {}): Record<string, string> {
  return token.get() ? { ...more, Authorization: `Bearer ${token.get()}` } : more;
}

/** Turns an answer that is none of success into an error, and lets a token be asked for. */
export async function checked(answer: Response): Promise<Response> {
  if (answer.ok) return answer;
  const body: { type?: string; title?: string; detail?: string } = await answer.json().catch(() => ({}));
  const message = body.detail ?? body.title ?? `the service answered ${answer.status} ${answer.statusText}`;
  if (answer.status === 401) askForToken(token.get() ? "This token is not known." : "");
  throw new Problem(answer.status, body.type ?? "unknown", message);
}

async function ask(method: string, path: string, body?: unknown): Promise<Response> {
  const init: RequestInit = { method, headers: headers(body === undefined ? {} : { "Content-Type": "application/json" }) };
  if (body !== undefined) init.body = JSON.stringify(body);
  let answer: Response;
  try {
    answer = await fetch(path, init);
  } catch {
    throw new Problem(0, "connection", "The scanner does not answer. Is the service running?");
  }
  return checked(answer);
}

export const get = async <T>(path: string): Promise<T> => (await ask("GET", path)).json() as Promise<T>;
export const post = async <T>(path: string, body: unknown = {}): Promise<T> =>
  (await ask("POST", path, body)).json() as Promise<T>;
export const put = async (path: string, body: unknown): Promise<void> => void (await ask("PUT", path, body));
export const patch = async (path: string, body: unknown): Promise<void> => void (await ask("PATCH", path, body));
export const remove = async (path: string): Promise<void> => void (await ask("DELETE", path));
export const file = (path: string): Promise<Response> => ask("GET", path);
export const bytes = async (path: string): Promise<ArrayBuffer> => (await file(path)).arrayBuffer();

/** Fetches a file and gives the address under which this page alone has it: links and pictures send no token. */
export async function local(path: string): Promise<string> {
  return URL.createObjectURL(await (await file(path)).blob());
}
