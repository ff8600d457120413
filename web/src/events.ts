/** The page's one stream of events: everything that changes comes by it. */

import { Problem, checked, get, headers } from "./api";
import { Messages } from "./sse";

export type Connection = "connecting" | "connected" | "lost" | "locked";
type Listener = (kind: string, data: any) => void;

const listeners = new Set<Listener>();
const watchers = new Set<(connection: Connection) => void>();

/** How long to wait before the next try, in milliseconds. */
const PAUSE = 1500;

/** A stream that is silent for so long is gone; the service gives a sign of life every five seconds. */
const SILENCE = 15_000;

let wake: () => void = () => undefined;

/** Calls `listener` with every event until the returned function is called. */
export function listen(listener: Listener): () => void {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

/** Calls `watcher` whenever the connection changes. */
export function watchConnection(watcher: (connection: Connection) => void): void {
  watchers.add(watcher);
}

/** Tries again at once, such as after a token was given. */
export function retry(): void {
  wake();
}

/** The latest revision of each scan and calibration that an event told of. */
const revisions = new Map<string, number>();

/** Whether an answer is older than what events have told already. */
export function isStale(known: { id: string; revision: number }): boolean {
  return known.revision < (revisions.get(known.id) ?? 0);
}

/** What is at `path`, at least as new as the events: an event may come a moment before the answer shows it. */
export async function current<T extends { id: string; revision: number }>(path: string): Promise<T> {
  for (let tries = 0; ; tries++) {
    const found = await get<T>(path);
    if (tries >= 40 || !isStale(found)) return found;
    await new Promise((done) => setTimeout(done, 50));
  }
}

function tell(kind: string, data: any): void {
  if (typeof data.id === "string" && typeof data.revision === "number") revisions.set(data.id, data.revision);
  for (const listener of [...listeners]) listener(kind, data);
}

async function read(last: { id: string | null }): Promise<void> {
  const abort = new AbortController();
  let timer = window.setTimeout(() => abort.abort(), SILENCE);
  const more: Record<string, string> = last.id ? { "Last-Event-ID": last.id } : {};
  try {
    const answer = await checked(await fetch("/v1/events", { headers: headers(more), signal: abort.signal }));
    if (!answer.body) throw new Error("the events have no body");
    watchers.forEach((watcher) => watcher("connected"));
    const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
    const messages = new Messages();
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      clearTimeout(timer);
      timer = window.setTimeout(() => abort.abort(), SILENCE);
      for (const message of messages.take(value)) {
        if (message.id) last.id = message.id;
        tell(message.event, JSON.parse(message.data));
      }
    }
  } finally {
    clearTimeout(timer);
  }
}

/** Follows the service for ever. */
export async function follow(): Promise<never> {
  const last: { id: string | null } = { id: null };
  for (;;) {
    let now: Connection = "lost";
    try {
      await read(last);
    } catch (error) {
      if (error instanceof Problem && error.status === 401) now = "locked";
      // A number from another store; begin anew.
      if (error instanceof Problem && error.status === 422) last.id = null;
    }
    watchers.forEach((watcher) => watcher(now));
    await new Promise<void>((done) => {
      wake = done;
      setTimeout(done, PAUSE);
    });
    watchers.forEach((watcher) => watcher("connecting"));
  }
}
