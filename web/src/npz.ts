/** Reads the maps that the scanner writes: arrays of numpy in an archive without compression. */

/** One map; row by row from the top. */
export interface Grid {
  width: number;
  height: number;
  values: Float32Array | Uint8Array;
}

const [LOCAL, ENTRY, END] = [0x04034b50, 0x02014b50, 0x06054b50];

function readNpy(bytes: Uint8Array, name: string): Grid {
  if (bytes.length < 10 || bytes[0] !== 0x93) throw new Error(`${name} is no array of numpy`);
  const length = bytes[6] === 1 ? bytes[8] + 256 * bytes[9] : new DataView(bytes.buffer, bytes.byteOffset + 8).getUint32(0, true);
  const start = (bytes[6] === 1 ? 10 : 12) + length;
  const header = new TextDecoder("latin1").decode(bytes.subarray(0, start));
  const shape = /'shape': \((\d+), (\d+)\)/.exec(header);
  const kind = /'descr': '([^']+)'/.exec(header)?.[1];
  if (!shape || header.includes("'fortran_order': True")) throw new Error(`${name} is no map of rows and columns`);
  const [height, width] = [Number(shape[1]), Number(shape[2])];
  const size = kind === "<f4" ? 4 : kind === "|u1" || kind === "|b1" ? 1 : 0;
  if (size === 0) throw new Error(`${name} has values of the unknown kind ${kind}`);
  if (bytes.length < start + width * height * size) throw new Error(`${name} ends too soon`);
  // A copy, since floats must lie at multiples of four bytes.
  const data = bytes.slice(start, start + width * height * size);
  return { width, height, values: size === 4 ? new Float32Array(data.buffer) : data };
}

/** Where the directory at the archive's end begins, and how many entries it has. */
function directory(view: DataView): { at: number; entries: number } {
  for (let at = view.byteLength - 22; at >= 0 && at >= view.byteLength - 22 - 65535; at--) {
    if (view.getUint32(at, true) === END) return { at: view.getUint32(at + 16, true), entries: view.getUint16(at + 10, true) };
  }
  throw new Error("the file of maps is no archive, or not a whole one");
}

/** All arrays of an archive by name, without `.npy`. */
export function readNpz(data: ArrayBuffer): Map<string, Grid> {
  const grids = new Map<string, Grid>();
  const view = new DataView(data);
  // The directory alone tells lengths for sure: a writer that streams leaves them out of what stands before a file.
  let { at, entries } = directory(view);
  for (; entries > 0; entries--) {
    if (at + 46 > view.byteLength || view.getUint32(at, true) !== ENTRY) throw new Error("the directory of the maps is damaged");
    const lengths = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
    const name = new TextDecoder().decode(new Uint8Array(data, at + 46, lengths[0]));
    const [size, local] = [view.getUint32(at + 20, true), view.getUint32(at + 42, true)];
    if (view.getUint16(at + 10, true) !== 0) throw new Error(`${name} is compressed`);
    if (local + 30 > view.byteLength || view.getUint32(local, true) !== LOCAL) throw new Error(`${name} is not where the directory says`);
    const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    if (start + size > data.byteLength) throw new Error(`the archive of maps ends within ${name}`);
    grids.set(name.replace(/\.npy$/, ""), readNpy(new Uint8Array(data, start, size), name));
    at += 46 + lengths[0] + lengths[1] + lengths[2];
  }
  return grids;
}
