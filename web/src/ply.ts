/** Reads the point clouds that the scanner writes: binary PLY, little endian, one element `vertex`. */

/** A cloud as arrays; coordinates in millimetres, x right, y down, z forward from the camera. */
export interface Cloud {
  count: number;
  /** x, y, z of each point in turn. */
  positions: Float32Array;
  /** Brightness, 0 to 255. */
  intensity: Uint8Array;
  /** Standard deviation of the depth in millimetres; not a number where it is not told. */
  sigma: Float32Array;
  /** Bits: 0 edge, 1 half saturated, 2 inverted, 3 interpolated, 4 near a silhouette. */
  flags: Uint8Array;
}

const BYTES: Record<string, number> = {
  char: 1, uchar: 1, short: 2, ushort: 2, int: 4, uint: 4, float: 4, double: 8,
  int8: 1, uint8: 1, int16: 2, uint16: 2, int32: 4, uint32: 4, float32: 4, float64: 8,
};

interface Property {
  type: string;
  offset: number;
}

interface Header {
  count: number;
  stride: number;
  start: number;
  properties: Map<string, Property>;
}

const END = "end_header\n";

function readHeader(bytes: Uint8Array): Header {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, 65536));
  const end = text.indexOf(END);
  if (!text.startsWith("ply\n") || end < 0) throw new Error("the cloud is no PLY file");
  if (!text.includes("\nformat binary_little_endian 1.0\n")) throw new Error("the cloud is not binary, little endian");
  const header: Header = { count: -1, stride: 0, start: end + END.length, properties: new Map() };
  for (const line of text.slice(0, end).split("\n")) {
    const words = line.split(" ");
    if (words[0] === "element") {
      if (words[1] !== "vertex" || header.count >= 0) throw new Error(`the cloud has an element ${words[1]} too many`);
      header.count = Number(words[2]);
    } else if (words[0] === "property") {
      const size = BYTES[words[1]];
      if (!size) throw new Error(`the cloud has a property of the unknown type ${words[1]}`);
      header.properties.set(words[2], { type: words[1], offset: header.stride });
      header.stride += size;
    }
  }
  if (!Number.isSafeInteger(header.count) || header.count < 0) throw new Error("the cloud does not tell its points");
  return header;
}

/** Reads one cloud; an error says in words what is wrong with the file. */
export function readPly(data: ArrayBuffer): Cloud {
  const header = readHeader(new Uint8Array(data));
  const { count, stride, start, properties } = header;
  if (data.byteLength < start + count * stride) {
    throw new Error(`the cloud ends after ${data.byteLength} of ${start + count * stride} bytes`);
  }
  const view = new DataView(data, start);
  const float = (name: string): number | null => {
    const found = properties.get(name);
    return found && (found.type === "float" || found.type === "float32") ? found.offset : null;
  };
  const byte = (name: string): number | null => {
    const found = properties.get(name);
    return found && (found.type === "uchar" || found.type === "uint8") ? found.offset : null;
  };
  const axes = ["x", "y", "z"].map(float);
  const cloud: Cloud = {
    count,
    positions: new Float32Array(count * 3),
    intensity: new Uint8Array(count).fill(200),
    sigma: new Float32Array(count).fill(NaN),
    flags: new Uint8Array(count),
  };
  const [x, y, z] = axes;
  if (x === null || y === null || z === null) throw new Error("the cloud has no x, y and z of single precision");
  const [sigma, intensity, flags] = [float("sigma_z"), byte("intensity"), byte("flags")];
  for (let index = 0, at = 0; index < count; index++, at += stride) {
    cloud.positions[index * 3] = view.getFloat32(at + x, true);
    cloud.positions[index * 3 + 1] = view.getFloat32(at + y, true);
    cloud.positions[index * 3 + 2] = view.getFloat32(at + z, true);
    if (sigma !== null) cloud.sigma[index] = view.getFloat32(at + sigma, true);
    if (intensity !== null) cloud.intensity[index] = view.getUint8(at + intensity);
    if (flags !== null) cloud.flags[index] = view.getUint8(at + flags);
  }
  return cloud;
}
