/** Reads the maps that the scanner writes: arrays of numpy in an archive without compression. */

/** One map; row by row from the top. */
export interface Grid {
  width: number;
  height: number;
  values: Float32Array | Uint8Array;
}

const LOCAL = 0x04034b50;

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

/** All arrays of an archive by name, without `.npy`. */
export function readNpz(data: ArrayBuffer): Map<string, Grid> {
  const grids = new Map<string, Grid>();
  const view = new DataView(data);
  let at = 0;
  while (at + 30 <= data.byteLength && view.getUint32(at, true) === LOCAL) {
    const size = view.getUint32(at + 18, true);
    const [nameLength, extraLength] = [view.getUint16(at + 26, true), view.getUint16(at + 28, true)];
    const name = new TextDecoder().decode(new Uint8Array(data, at + 30, nameLength));
    if (view.getUint16(at + 8, true) !== 0) throw new Error(`${name} is compressed`);
    const start = at + 30 + nameLength + extraLength;
    if (start + size > data.byteLength) throw new Error(`the archive of maps ends within ${name}`);
    grids.set(name.replace(/\.npy$/, ""), readNpy(new Uint8Array(data, start, size), name));
    at = start + size;
  }
  if (grids.size === 0) throw new Error("the file of maps is no archive");
  return grids;
}
