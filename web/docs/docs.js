"use strict";
const make = (tag, text, name) => {
  const node = document.createElement(tag);
  if (text !== undefined) node.textContent = text;
  if (name) node.className = name;
  return node;
};
let api;

const resolve = (schema) => (schema && schema.$ref ? api.components.schemas[schema.$ref.split("/").pop()] : schema);

// A body to start from: every property with a value of its kind.
function sample(schema) {
  schema = resolve(schema) || {};
  const properties = schema.properties || {};
  const value = (one) => {
    one = resolve(one) || {};
    const kind = [].concat(one.type || [])[0];
    return { string: "", boolean: false, integer: 1, number: 1, array: [] }[kind] ?? null;
  };
  return Object.fromEntries(Object.entries(properties).map(([name, one]) => [name, value(one)]));
}

function parameters(operation) {
  const list = operation.parameters || [];
  const inputs = list.map((parameter) => {
    const input = make("input");
    input.title = parameter.description || "";
    const label = make("label", parameter.name + " (" + parameter.in + ") ");
    label.append(input);
    return { parameter, input, label };
  });
  return inputs;
}

function operate(method, path, operation) {
  const box = make("details");
  const head = make("summary");
  head.append(make("span", method.toUpperCase(), "method"), make("code", path), " " + (operation.summary || ""));
  box.append(head);
  if (operation.description) box.append(make("p", operation.description));
  const inputs = parameters(operation);
  const fields = make("p", undefined, "row");
  inputs.forEach((one) => fields.append(one.label));
  box.append(fields);
  const content = operation.requestBody && operation.requestBody.content["application/json"];
  const body = make("textarea");
  if (content) { body.value = JSON.stringify(sample(content.schema), null, 2); box.append(body); }
  const table = make("table");
  for (const [status, answer] of Object.entries(operation.responses || {})) {
    const row = table.insertRow();
    row.insertCell().textContent = status;
    row.insertCell().textContent = answer.description;
  }
  const button = make("button", "Send");
  const out = make("pre");
  out.hidden = true;
  button.addEventListener("click", async () => {
    out.hidden = false;
    out.textContent = "...";
    try {
      let url = path;
      const query = new URLSearchParams();
      const headers = {};
      for (const { parameter, input } of inputs) {
        if (parameter.in === "path") url = url.replace("{" + parameter.name + "}", encodeURIComponent(input.value));
        else if (input.value && parameter.in === "query") query.set(parameter.name, input.value);
        else if (input.value) headers[parameter.name] = input.value;
      }
      if (query.size) url += "?" + query;
      const token = document.getElementById("token").value.trim();
      if (token) headers.Authorization = "Bearer " + token;
      if (method !== "get") headers["Content-Type"] = "application/json";
      const answer = await fetch(url, { method: method.toUpperCase(), headers, body: content ? body.value : undefined });
      const kind = answer.headers.get("Content-Type") || "";
      let text = answer.status + " " + answer.statusText + "\n";
      answer.headers.forEach((value, name) => { text += name + ": " + value + "\n"; });
      if (kind.includes("event-stream") || kind.includes("x-mixed-replace")) {
        const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
        const end = Date.now() + 5000;
        text += "\n(the first five seconds)\n";
        while (Date.now() < end) {
          const { value, done } = await reader.read();
          if (done) break;
          text += value.slice(0, 4000);
          out.textContent = text;
        }
        reader.cancel();
      } else if (kind.includes("json")) text += "\n" + JSON.stringify(await answer.json(), null, 2);
      else if (kind.startsWith("text") || kind.includes("openmetrics")) text += "\n" + (await answer.text());
      else text += "\n" + (await answer.blob()).size + " bytes";
      out.textContent = text;
    } catch (error) { out.textContent = String(error); }
  });
  box.append(button, out, table);
  return box;
}

async function start() {
  api = await (await fetch("/openapi.json")).json();
  document.getElementById("about").textContent = api.info.description;
  const main = document.getElementById("operations");
  for (const tag of api.tags) {
    main.append(make("h2", tag.name + ": " + tag.description));
    for (const [path, methods] of Object.entries(api.paths)) {
      for (const [method, operation] of Object.entries(methods)) {
        if ((operation.tags || []).includes(tag.name)) main.append(operate(method, path, operation));
      }
    }
  }
  const problems = document.getElementById("problems");
  for (const problem of await (await fetch("/assets/problems.json")).json()) {
    const row = problems.insertRow();
    row.insertCell().append(make("code", problem.type));
    row.insertCell().textContent = problem.status;
    row.insertCell().textContent = problem.title;
  }
  for (const [name, schema] of Object.entries(api.components.schemas)) {
    const box = make("details");
    box.append(make("summary", name), make("pre", JSON.stringify(schema, null, 2)));
    document.getElementById("schemas").append(box);
  }
}
start();
