// Holds the parts of the page to the licences that deny.toml allows. What only tests it may be under MPL-2.0 as well: it
// is changed by nobody and given to nobody.
import { readFileSync } from "node:fs";

const root = new URL("..", import.meta.url);
const list = /\nallow = \[([^\]]*)\]/.exec(readFileSync(new URL("deny.toml", root), "utf8"))?.[1];
const allowed = new Set([...(list ?? "").matchAll(/"([^"]+)"/g)].map((match) => match[1]));
const { packages } = JSON.parse(readFileSync(new URL("web/package-lock.json", root), "utf8"));
const parts = Object.entries(packages).filter(([path]) => path !== "");
if (allowed.size === 0 || parts.length === 0) throw new Error("deny.toml or web/package-lock.json is not what it was");
const refused = parts.filter(([, part]) => !allowed.has(part.license) && !(part.dev && part.license === "MPL-2.0"));
for (const [path, part] of refused) console.error(`licences: ${path} is under ${part.license ?? "no licence"}, which deny.toml does not allow`);
if (refused.length > 0) process.exit(1);
console.log(`licences: ${parts.length} parts of the page, all allowed`);
