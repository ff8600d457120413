/** Scans in words. */

import type { Cause, Report, Run, Scan } from "./api";

export type Tone = "good" | "warn" | "bad" | "busy" | "plain";

const STATES: Record<Scan["state"], string> = {
  queued: "waiting",
  projecting: "scanning",
  acquired: "captured",
  decoding: "computing",
  done: "done",
  failed: "failed",
  cancelled: "cancelled",
  interrupted: "interrupted",
};

const VERDICTS: Record<string, [Tone, string]> = {
  ok: ["good", "✓ ok"],
  degraded: ["warn", "! degraded"],
  failed: ["bad", "✗ failed"],
};

/** Whether nothing more will come of a scan. */
export const isOver = (scan: Pick<Scan, "state">): boolean =>
  ["done", "failed", "cancelled", "interrupted"].includes(scan.state);

/** State or verdict of a scan, in a word. */
export function outcome(scan: Scan): [Tone, string] {
  if (scan.state === "cancelled" || scan.state === "interrupted") return ["plain", STATES[scan.state]];
  if (scan.verdict) return VERDICTS[scan.verdict] ?? ["plain", scan.verdict];
  if (scan.state === "failed") return VERDICTS.failed;
  if (scan.held) return ["plain", "held"];
  return [isOver(scan) ? "plain" : "busy", STATES[scan.state]];
}

/** A slug such as `stale-frame` as a heading. */
export function title(type: string): string {
  const words = type.replaceAll("-", " ");
  return words[0].toUpperCase() + words.slice(1);
}

/** A message of the service as whole sentences. */
export function sentences(message: string): string {
  const text = message.trim();
  if (!text) return "";
  return text[0].toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".");
}

/** What the verdict means for the one who wants to use the result. */
export function meaning(scan: Scan): string {
  switch (scan.state === "cancelled" || scan.state === "interrupted" ? scan.state : (scan.verdict ?? scan.state)) {
    case "ok":
      return "Nothing speaks against the result.";
    case "degraded":
      return "The result can be used, knowing this:";
    case "failed":
      return "The result cannot be used. This is why, and what to do:";
    case "cancelled":
      return "The scan was cancelled; there is no result.";
    case "interrupted":
      return "The service ended during the scan; scan again.";
    default:
      return "The scan is not finished yet.";
  }
}

/** All that was found wrong, the gravest first, each once. */
export function causes(scan: Scan, report: Report | null): Cause[] {
  const found = report?.reasons.length ? report.reasons : scan.reasons;
  if (found.length > 0) return found;
  return scan.error ? [scan.error] : [];
}

/** Share of the lit pixels that were measured, in percent; `null` where nothing was lit. */
export function coverage(report: Report): number | null {
  if (!report.pixels) return null;
  const { lit, valid } = report.pixels;
  return lit > 0 ? (100 * valid) / lit : null;
}

/** Where a calibration is. */
export function calibrationOutcome(run: Run): [Tone, string] {
  if (run.state === "open" && run.accepted === false) return ["bad", "✗ refused, open"];
  if (run.state === "running" || run.state === "open") return ["busy", run.state];
  if (run.state !== "done") return [run.state === "failed" ? "bad" : "plain", run.state];
  if (run.accepted === false) return ["bad", "✗ refused"];
  return run.accepted ? ["good", "✓ accepted"] : ["plain", "done"];
}
