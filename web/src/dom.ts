/** Elements, written down shortly. */

type Child = Node | string | null | undefined | false;

/** Makes an element; `on…` keys are listeners, `true` is an attribute without value, `false` and null are none. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Record<string, unknown> = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on") && typeof value === "function") element.addEventListener(name.slice(2), value as EventListener);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.filter((child): child is Node | string => child instanceof Node || typeof child === "string"));
  return element;
}

/** A choice among values with their names. */
export function choice(id: string, options: [string, string][], onchange?: () => void): HTMLSelectElement {
  const select = h("select", { id, onchange }, ...options.map(([value, name]) => h("option", { value }, name)));
  return select;
}

/** A control with its name. */
export function field(name: string, control: HTMLElement): HTMLLabelElement {
  return h("label", { class: "field" }, h("span", {}, name), control);
}

const said = () => document.getElementById("problem") as HTMLElement;

/** Tells the operator what went wrong; nothing where `error` is missing. */
export function say(error?: unknown): void {
  const message = error === undefined ? "" : error instanceof Error ? error.message : String(error);
  said().textContent = message ? message[0].toUpperCase() + message.slice(1) : "";
}

/** A listener that tells what goes wrong within it. */
export function guarded(act: () => Promise<unknown> | void): () => void {
  return () => {
    say();
    Promise.resolve().then(act).catch(say);
  };
}

/** What a number of bytes is called. */
export function size(bytes: number): string {
  if (bytes >= 2 ** 30) return `${(bytes / 2 ** 30).toFixed(1)} GiB`;
  if (bytes >= 2 ** 20) return `${(bytes / 2 ** 20).toFixed(1)} MiB`;
  return `${Math.ceil(bytes / 1024)} KiB`;
}

/** A number with its thousands set apart. */
export const count = (value: number): string => value.toLocaleString("en-GB").replaceAll(",", "\u202f");

/** A moment of the service, in the operator's time. */
export const moment = (text: string): string =>
  new Date(text).toLocaleString("sv-SE", { dateStyle: "short", timeStyle: "medium" });

/** A word about the state of something, told by sign and colour. */
export function badge(kind: "good" | "warn" | "bad" | "busy" | "plain", text: string): HTMLElement {
  return h("span", { class: `badge ${kind}` }, text);
}
