import { expect, test } from "@playwright/test";
import { readFileSync, readdirSync } from "node:fs";
import { join, resolve } from "node:path";
import { gzipSync } from "node:zlib";
import { FEWEST, PATIENCE_MS, budget, growth, spread } from "../../src/detail";
import { histogram } from "../../src/histogram";
import { readNpz } from "../../src/npz";
import { parula, quantiles } from "../../src/parula";
import { readPly } from "../../src/ply";
import { distance, fitLine, pick, section } from "../../src/section";
import { Messages } from "../../src/sse";
import { sentences, title } from "../../src/words";

/** Numbers that look like chance and are the same each time. */
function chance(seed: number): () => number {
  let state = seed;
  return () => {
    state = (state * 1664525 + 1013904223) % 2 ** 32;
    return state / 2 ** 32;
  };
}

const buffer = (bytes: Buffer): ArrayBuffer => new Uint8Array(bytes).buffer;

test("parula grows in lightness all the way, and is grey for nothing", () => {
  let last = -1;
  const rgb = new Uint8Array(3);
  for (let step = 0; step <= 100; step++) {
    parula(step / 100, rgb, 0);
    const luminance = 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2];
    expect(luminance).toBeGreaterThanOrEqual(last - 0.6);
    last = luminance;
  }
  parula(7, rgb, 0);
  expect([...rgb]).toEqual([249, 251, 21]);
  parula(NaN, rgb, 0);
  expect([...rgb]).toEqual([96, 96, 96]);
});

test("quantiles pass over what is no number", () => {
  expect(quantiles([3, NaN, 1, 2, Infinity, 5, 4], 0, 1)).toEqual([1, 5]);
  expect(quantiles([NaN], 0, 1)).toEqual([0, 1]);
});

test("a cloud is read as it was written, in any order of properties, and damage is named", () => {
  const header = "ply\nformat binary_little_endian 1.0\ncomment units mm\nelement vertex 2\nproperty float z\nproperty uchar intensity\nproperty float x\nproperty float y\nproperty float sigma_z\nproperty uchar flags\nend_header\n";
  const body = Buffer.alloc(36);
  [[3, 10, 1, 2, 0.5, 17], [-6, 255, -4, -5, 0.25, 0]].forEach(([z, intensity, x, y, sigma, flags], index) => {
    const at = index * 18;
    body.writeFloatLE(z, at);
    body.writeUInt8(intensity, at + 4);
    body.writeFloatLE(x, at + 5);
    body.writeFloatLE(y, at + 9);
    body.writeFloatLE(sigma, at + 13);
    body.writeUInt8(flags, at + 17);
  });
  const file = Buffer.concat([Buffer.from(header), body]);
  const cloud = readPly(buffer(file));
  expect([...cloud.positions]).toEqual([1, 2, 3, -4, -5, -6]);
  expect([...cloud.intensity]).toEqual([10, 255]);
  expect([...cloud.sigma]).toEqual([0.5, 0.25]);
  expect([...cloud.flags]).toEqual([17, 0]);
  expect(() => readPly(buffer(file.subarray(0, -1)))).toThrow("ends after");
  expect(() => readPly(buffer(Buffer.from("nonsense")))).toThrow("no PLY");
  expect(() => readPly(buffer(Buffer.from(header.replace("float x", "list x"))))).toThrow("unknown type list");
});

function npy(kind: string, shape: string, data: Buffer): Buffer {
  const text = `{'descr': '${kind}', 'fortran_order': False, 'shape': ${shape}, }`.padEnd(117) + "\n";
  return Buffer.concat([Buffer.from([0x93, ...Buffer.from("NUMPY"), 1, 0, text.length & 255, text.length >> 8]), Buffer.from(text), data]);
}

/** An archive as a writer that streams makes it: lengths stand in the directory alone. */
function archived(files: [string, Buffer][], method = 0): Buffer {
  const [parts, entries]: Buffer[][] = [[], []];
  let at = 0;
  for (const [name, data] of files) {
    const head = Buffer.alloc(30);
    head.writeUInt32LE(0x04034b50, 0);
    head.writeUInt16LE(name.length, 26);
    const entry = Buffer.alloc(46);
    entry.writeUInt32LE(0x02014b50, 0);
    entry.writeUInt16LE(method, 10);
    entry.writeUInt32LE(data.length, 20);
    entry.writeUInt16LE(name.length, 28);
    entry.writeUInt32LE(at, 42);
    parts.push(head, Buffer.from(name), data);
    entries.push(entry, Buffer.from(name));
    at += 30 + name.length + data.length;
  }
  const end = Buffer.alloc(22);
  end.writeUInt32LE(0x06054b50, 0);
  end.writeUInt16LE(files.length, 10);
  end.writeUInt32LE(at, 16);
  return Buffer.concat([...parts, ...entries, end]);
}

test("maps are read from an archive, and damage is named", () => {
  const floats = Buffer.from(new Float32Array([1.5, NaN, -2, 4, 5, 6]).buffer);
  const files: [string, Buffer][] = [["depth.npy", npy("<f4", "(2, 3)", floats)], ["class.npy", npy("|u1", "(1, 2)", Buffer.from([7, 9]))]];
  const archive = archived(files);
  const grids = readNpz(buffer(archive));
  expect([...grids.keys()]).toEqual(["depth", "class"]);
  expect([grids.get("depth")?.width, grids.get("depth")?.height]).toEqual([3, 2]);
  expect([...(grids.get("depth")?.values ?? [])]).toEqual([1.5, NaN, -2, 4, 5, 6]);
  expect([...(grids.get("class")?.values ?? [])]).toEqual([7, 9]);
  expect(() => readNpz(buffer(archive.subarray(0, -1)))).toThrow("not a whole one");
  expect(() => readNpz(buffer(archived(files, 8)))).toThrow("depth.npy is compressed");
  expect(() => readNpz(buffer(Buffer.from("no archive at all, surely not")))).toThrow("no archive");
  expect(() => readNpz(buffer(archived([["a.npy", npy("<f8", "(1, 1)", Buffer.alloc(8))]])))).toThrow("unknown kind <f8");
});

test("a section takes what lies between its ends and within its thickness", () => {
  const random = chance(1);
  const positions = Float32Array.from({ length: 3000 }, (_, index) => (index % 3 === 2 ? 500 : 0) + 20 * random());
  const [a, b] = [[3, 4, 0], [15, 13, 0]] as const;
  const cut = section(positions, a, b, 2);
  // The obvious way: the foot of each point on the line.
  let expected = 0;
  for (let at = 0; at < positions.length; at += 3) {
    const t = ((positions[at] - a[0]) * 12 + (positions[at + 1] - a[1]) * 9) / 225;
    const off = Math.hypot(positions[at] - a[0] - 12 * t, positions[at + 1] - a[1] - 9 * t);
    if (t >= 0 && t <= 1 && off <= 1) expected++;
  }
  expect(expected).toBeGreaterThan(20);
  expect(cut.along.length).toBe(expected);
  expect([...cut.along].sort((one, other) => one - other)).toEqual(cut.along);
  expect(section(positions, a, a, 2).along).toEqual([]);
});

test("the line is the best one, and its rest is measured at right angles", () => {
  const random = chance(2);
  const along = Array.from({ length: 200 }, (_, index) => index / 4);
  const depth = along.map((x) => 700 + 0.75 * x + random() - 0.5);
  const line = fitLine({ along, depth })!;
  const rmse = (slope: number, offset: number) =>
    Math.sqrt(along.reduce((sum, x, index) => sum + (depth[index] - offset - slope * x) ** 2 / (1 + slope ** 2), 0) / along.length);
  expect(line.rmse).toBeCloseTo(rmse(line.slope, line.offset), 9);
  for (const [slope, offset] of [[0.002, 0], [-0.002, 0], [0, 0.02], [0, -0.02]]) {
    expect(rmse(line.slope + slope, line.offset + offset)).toBeGreaterThan(line.rmse);
  }
  const exact = fitLine({ along: [0, 1, 2], depth: [5, 7, 9] })!;
  expect([exact.slope, exact.offset, exact.rmse].map((value) => Math.round(value * 1e6) / 1e6)).toEqual([2, 5, 0]);
  expect(fitLine({ along: [0, 1], depth: [0, 1] })).toBeNull();
});

test("the point under the pointer is the one in front", () => {
  // w is the depth, x and y are divided by it.
  const matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0];
  const positions = new Float32Array([0, 0, 9, 0, 0, 4, 2, 0, 4, 0, 0, -1]);
  const size = { width: 200, height: 100 };
  expect(pick(positions, matrix, size, { x: 101, y: 50 }, 5)).toBe(1);
  expect(pick(positions, matrix, size, { x: 150, y: 50 }, 5)).toBe(2);
  expect(pick(positions, matrix, size, { x: 10, y: 10 }, 5)).toBe(-1);
  expect(distance([1, 2, 3], [1, 5, 7])).toBe(5);
});

test("every beginning of the order of drawing is an even sample", () => {
  for (const count of [0, 1, 2, 7, 1000, 120_000]) {
    expect(new Set(spread(count)).size, `${count} points, each once`).toBe(count);
  }
  const count = 100_000;
  const bins = new Array<number>(100).fill(0);
  for (const index of spread(count).subarray(0, 5000)) bins[Math.floor((index * 100) / count)]++;
  expect(Math.min(...bins)).toBeGreaterThanOrEqual(45);
  expect(Math.max(...bins)).toBeLessThanOrEqual(55);
});

test("the level of detail settles where a picture takes as long as it may", () => {
  const cost = 0.0005; // milliseconds for each point
  let drawn = 2_000_000;
  for (let round = 0; round < 40; round++) drawn = budget(drawn, drawn * cost, 2_000_000);
  expect(drawn * cost).toBeCloseTo(PATIENCE_MS, 0);
  expect(budget(FEWEST, 5000, 2_000_000)).toBe(FEWEST);
  expect(budget(500, 1, 600)).toBe(600);
  expect(growth(500_000, 2_000_000)).toBe(2);
  expect(growth(1, 2_000_000)).toBe(3);
});

test("events come whole, however they are cut", () => {
  const text = ": hello\nretry: 2000\n\nid: 5\nevent: scan\ndata: {\"a\":\ndata: 1}\n\n: alive\n\nevent: gap\ndata: {}\n\n";
  for (let size = 1; size < text.length; size++) {
    const messages = new Messages();
    const found = [];
    for (let at = 0; at < text.length; at += size) found.push(...messages.take(text.slice(at, at + size)));
    expect(found).toEqual([
      { id: "5", event: "scan", data: '{"a":\n1}' },
      { id: null, event: "gap", data: "{}" },
    ]);
  }
});

test("the histogram counts saturated pixels, which are red, as the brightest", () => {
  const counts = histogram([0, 0, 0, 255, 128, 128, 128, 255, 254, 0, 2, 255, 255, 255, 255, 255], 4);
  expect(counts).toEqual([1, 0, 1, 2]);
});

test("slugs and messages become words", () => {
  expect(title("stale-frame")).toBe("Stale frame");
  expect(sentences("look again")).toBe("Look again.");
  expect(sentences("")).toBe("");
});

test("the script is less than 1 MB, compressed", () => {
  const folder = resolve(import.meta.dirname, "../../dist/assets");
  const scripts = readdirSync(folder).filter((name) => name.endsWith(".js"));
  expect(scripts.sort()).toEqual(["cloud.js", "page.js"]);
  const bytes = scripts.reduce((sum, name) => sum + gzipSync(readFileSync(join(folder, name))).length, 0);
  expect(readFileSync(join(folder, "cloud.js"), "utf8"), "what is passed on keeps its licence").toContain("three.js authors");
  console.log(`${bytes} bytes of script, compressed`);
  expect(bytes).toBeLessThan(1_000_000);
});
