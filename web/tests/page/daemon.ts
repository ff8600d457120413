/** The service, in a process of its own, on a small twin. */

import { type ChildProcess, execFileSync, spawn } from "node:child_process";
import { appendFileSync, existsSync, mkdtempSync, readFileSync, rmSync } from "node:fs";
import { request } from "node:http";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";

const ROOT = resolve(import.meta.dirname, "../../..");
const BINARY = process.env.POLSCAN_BINARY ?? join(ROOT, "target/debug/polscan");
const PYTHON = process.env.POLSCAN_PYTHON ?? join(ROOT, ".cache/python/bin/python");

export interface Rig {
  /** What the paper's rig is divided by. */
  scale?: number;
  /** Keys of the configuration, `table.key=value`. */
  set?: string[];
  /** Entries of `[[sim.faults]]`. */
  fault?: string;
}

export class Daemon {
  readonly folder = mkdtempSync(join(tmpdir(), "polscan-page-"));
  private process: ChildProcess | null = null;
  private address = "127.0.0.1:0";

  constructor(rig: Rig = {}) {
    execFileSync(PYTHON, [join(ROOT, "tests/python/small_twin.py"), this.folder, String(rig.scale ?? 4), ...(rig.set ?? [])]);
    if (rig.fault) appendFileSync(join(this.folder, "polscan.toml"), `\n[[sim.faults]]\n${rig.fault}\n`);
  }

  get url(): string {
    return `http://${this.address}`;
  }

  /** Makes the service ask for tokens, and gives back one. */
  addToken(scope: string): string {
    const file = join(this.folder, "tokens.toml");
    const secret = execFileSync(BINARY, ["token", "add", scope, "--scope", scope, "--file", file], { encoding: "utf8" });
    appendFileSync(join(this.folder, "polscan.toml"), `\n[api]\ntokens = ${JSON.stringify(file)}\n`);
    return secret.trim().split("\n")[0].trim();
  }

  /** Starts it; after the first time on the address that it had. */
  async start(): Promise<this> {
    const told = join(this.folder, "address");
    rmSync(told, { force: true });
    const options = ["--config", "polscan.toml", "--listen", this.address, "--address-file", told];
    const child = spawn(BINARY, ["serve", ...options], { cwd: this.folder, stdio: ["ignore", "ignore", "pipe"] });
    let log = "";
    child.stderr?.on("data", (text) => (log += text));
    this.process = child;
    for (const begin = Date.now(); !existsSync(told); await new Promise((done) => setTimeout(done, 20))) {
      if (child.exitCode !== null || Date.now() - begin > 20_000) throw new Error(`the service does not start:\n${log}`);
    }
    this.address = readFileSync(told, "utf8").trim();
    return this;
  }

  /** Kills it, as a loss of power would. */
  async kill(): Promise<void> {
    const child = this.process;
    this.process = null;
    if (!child || child.exitCode !== null) return;
    const ended = new Promise((done) => child.once("exit", done));
    child.kill("SIGKILL");
    await ended;
  }

  /** Ends it for good. */
  async end(): Promise<void> {
    await this.kill();
    rmSync(this.folder, { recursive: true, force: true });
  }

  async get(path: string): Promise<any> {
    return this.ask("GET", path);
  }

  /** Scans and waits for the end. */
  async scan(body: object = {}): Promise<any> {
    return this.ask("POST", "/v1/scans?wait=done", JSON.stringify(body));
  }

  /** Asks over a connection of its own: one that is kept may have been closed by the time it is used again. */
  private ask(method: string, path: string, body?: string): Promise<any> {
    return new Promise((done, failed) => {
      const headers = { "Content-Type": "application/json", Connection: "close" };
      const asked = request(this.url + path, { method, headers, agent: false }, (answer) => {
        let text = "";
        answer.setEncoding("utf8").on("data", (part) => (text += part));
        answer.on("end", () => {
          if ((answer.statusCode ?? 500) < 300) done(JSON.parse(text));
          else failed(new Error(`${method} ${path}: ${answer.statusCode} ${text}`));
        });
        answer.on("error", failed);
      });
      asked.on("error", failed);
      asked.end(body);
    });
  }
}
