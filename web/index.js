"use strict";
const at = (id) => document.getElementById(id);
let token = sessionStorage.getItem("token") || "";
let current = null;
let looking = false;

async function call(method, path, body) {
  const headers = {};
  if (token) headers.Authorization = "Bearer " + token;
  if (method !== "GET") headers["Content-Type"] = "application/json";
  const answer = await fetch(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  if (answer.status === 401) at("login").hidden = false;
  if (!answer.ok) {
    const problem = await answer.json().catch(() => ({ detail: answer.statusText }));
    throw new Error(problem.detail || problem.title);
  }
  return answer;
}

function say(error) { at("problem").textContent = error ? String(error.message || error) : ""; }
const guarded = (act) => async () => { say(); try { await act(); } catch (error) { say(error); } };

async function status() {
  const now = await (await call("GET", "/v1/status")).json();
  const reasons = now.reasons.map((reason) => reason.message).join("; ");
  at("status").textContent = now.state + (now.queue.length ? ", " + now.queue.length + " waiting" : "");
  at("status").className = "state " + (now.state === "fault" ? "bad" : now.state === "idle" ? "good" : "busy");
  const free = now.storage.free_bytes;
  at("room").textContent = free === null ? "" : (free / 2 ** 30).toFixed(1) + " GiB free";
  if (reasons && now.state !== "stopping") say(reasons);
  current = now.capturing;
  at("cancel").disabled = !current;
}

function cell(row, content) {
  const td = row.insertCell();
  if (content instanceof Node) td.append(content); else td.textContent = content ?? "";
  return td;
}

function file(href, text) {
  const link = document.createElement("a");
  link.textContent = text;
  link.href = href;
  link.addEventListener("click", guardedLink(href));
  return link;
}

// A link sends no token, so that files are fetched and handed over.
function guardedLink(href) {
  return (event) => {
    if (!token) return;
    event.preventDefault();
    guarded(async () => {
      const blob = await (await call("GET", href)).blob();
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = href.split("/").pop();
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 60000);
    })();
  };
}

async function list() {
  const page = await (await call("GET", "/v1/scans?limit=20")).json();
  const body = at("scans");
  body.replaceChildren();
  for (const scan of page.scans) {
    const row = body.insertRow();
    cell(row, scan.created.replace("T", " ").slice(0, 19));
    cell(row, scan.label || scan.id.slice(0, 13));
    cell(row, scan.state + (scan.held ? " (held)" : ""));
    const verdict = cell(row, scan.verdict || (scan.error && scan.error.type));
    verdict.className = scan.verdict === "ok" ? "good" : scan.verdict ? "busy" : "bad";
    verdict.title = scan.reasons.map((reason) => reason.message).join("\n");
    const files = document.createElement("span");
    if (scan.bytes !== null) {
      if (scan.points !== null) files.append(file(scan.href + "/cloud.ply", "cloud"), " ");
      files.append(file(scan.href + "/report.json", "report"), " ", file(scan.href + "/bundle.zip", "all"));
    }
    cell(row, files);
  }
}

async function show(scan) {
  const artifacts = (await (await call("GET", scan.href || "/v1/scans/" + scan.id)).json()).artifacts;
  const overview = artifacts.find((artifact) => artifact.name === "overview.png");
  at("result").replaceChildren();
  if (!overview) return;
  const image = document.createElement("img");
  image.alt = "overview of the result";
  image.src = URL.createObjectURL(await (await call("GET", overview.href)).blob());
  at("result").append(image);
}

async function look() {
  while (looking) {
    const answer = await call("GET", "/v1/preview.jpg");
    at("light").textContent = "light: " + answer.headers.get("X-Polscan-Exposure");
    const frame = at("frame");
    const old = frame.src;
    frame.src = URL.createObjectURL(await answer.blob());
    frame.hidden = false;
    if (old) URL.revokeObjectURL(old);
    await new Promise((done) => setTimeout(done, 200));
  }
}

function told(kind, data) {
  if (kind === "progress") {
    at("progress").max = data.progress.of || 1;
    at("progress").value = data.progress.frames;
    at("step").textContent = data.progress.frames + " of " + data.progress.of;
    return;
  }
  if (kind === "scan") {
    at("step").textContent = data.state;
    if (data.state === "done") show(data).catch(say);
  }
  status().then(list).catch(say);
}

// EventSource sends no token, so that the stream is read by hand.
async function follow() {
  let last = null;
  for (;;) {
    try {
      const headers = token ? { Authorization: "Bearer " + token } : {};
      if (last) headers["Last-Event-ID"] = last;
      const answer = await fetch("/v1/events", { headers });
      if (!answer.ok) throw new Error("no events: " + answer.status);
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let text = "";
      await status();
      await list();
      for (;;) {
        const { value, done } = await reader.read();
        if (done) break;
        text += value;
        let end;
        while ((end = text.indexOf("\n\n")) >= 0) {
          const fields = {};
          for (const line of text.slice(0, end).split("\n")) {
            const colon = line.indexOf(": ");
            if (colon > 0) fields[line.slice(0, colon)] = line.slice(colon + 2);
          }
          text = text.slice(end + 2);
          if (fields.id) { last = fields.id; told(fields.event, JSON.parse(fields.data)); }
        }
      }
    } catch (error) {
      at("status").textContent = "no connection";
      at("status").className = "state bad";
    }
    await new Promise((done) => setTimeout(done, 2000));
  }
}

at("scan").addEventListener("click", guarded(async () => {
  const body = {};
  if (at("mode").value) body.mode = at("mode").value;
  if (at("label").value) body.label = at("label").value;
  if (at("exposure").value) body.exposure_us = Number(at("exposure").value);
  at("progress").value = 0;
  await call("POST", "/v1/scans", body);
}));
at("cancel").addEventListener("click", guarded(async () => {
  if (current) await call("POST", "/v1/scans/" + current + "/cancel", {});
}));
at("picture").addEventListener("change", guarded(() => call("PUT", "/v1/projector", { show: at("picture").value })));
at("preview").addEventListener("click", guarded(async () => {
  looking = !looking;
  at("preview").textContent = looking ? "Stop" : "Look";
  try { await look(); } finally { looking = false; at("preview").textContent = "Look"; }
}));
at("use-token").addEventListener("click", () => {
  token = at("token").value.trim();
  sessionStorage.setItem("token", token);
  location.reload();
});
follow();
