/** The cloud in three dimensions. */

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  Line,
  LineBasicMaterial,
  Matrix4,
  PerspectiveCamera,
  Points,
  PointsMaterial,
  Scene,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { FEWEST, budget, growth, spread } from "./detail";
import { parula, quantiles } from "./parula";
import type { Cloud } from "./ply";
import { pick, type Point } from "./section";

/** What points are coloured by. */
export type Colouring = "depth" | "sigma" | "class" | "intensity";

/** What a scale beside the cloud says. */
export type Legend = { low: number; high: number } | { names: [string, string][] } | null;

/** Classes of points by their flags, the first that fits. */
const CLASSES: { bit: number; name: string; colour: [number, number, number] }[] = [
  { bit: 4, name: "inverted", colour: [213, 94, 0] },
  { bit: 2, name: "half saturated", colour: [204, 121, 167] },
  { bit: 16, name: "near a silhouette", colour: [240, 228, 66] },
  { bit: 8, name: "interpolated", colour: [0, 158, 115] },
  { bit: 1, name: "on a stripe's edge", colour: [86, 180, 233] },
];
const PLAIN: [number, number, number] = [190, 190, 190];

/** How long the cloud must be left alone before all of it is drawn, in milliseconds. */
const REST_MS = 180;

/** How long a cloud that nobody has touched turns by itself, in milliseconds. */
const TURN_MS = 20_000;

/** Points that are added to a resting picture at once. */
const STRIDE = 150_000;

function range(cloud: Cloud, by: Colouring): [number, number] {
  if (by === "intensity") return [0, 255];
  if (by === "sigma") return quantiles(cloud.sigma, 0.02, 0.98);
  const depths = new Float32Array(cloud.count);
  for (let index = 0; index < cloud.count; index++) depths[index] = cloud.positions[index * 3 + 2];
  return quantiles(depths, 0.01, 0.99);
}

/** Colours of all points, in the cloud's order, and what the scale says. */
export function colours(cloud: Cloud, by: Colouring): { rgb: Uint8Array; legend: Legend } {
  const rgb = new Uint8Array(cloud.count * 3);
  const [low, high] = range(cloud, by);
  const width = high - low || 1;
  for (let index = 0; index < cloud.count; index++) {
    const at = index * 3;
    if (by === "class") {
      rgb.set(CLASSES.find((one) => cloud.flags[index] & one.bit)?.colour ?? PLAIN, at);
    } else if (by === "intensity") {
      rgb.fill(cloud.intensity[index], at, at + 3);
    } else {
      parula(((by === "sigma" ? cloud.sigma[index] : cloud.positions[at + 2]) - low) / width, rgb, at);
    }
  }
  const css = (colour: [number, number, number]) => `rgb(${colour.join(",")})`;
  const names: [string, string][] = [["plain", css(PLAIN)], ...CLASSES.map((one): [string, string] => [one.name, css(one.colour)])];
  return { rgb, legend: by === "class" ? { names } : { low, high } };
}

/** A cloud on a canvas. Points are counted as in the file; the tools speak of the camera's coordinates. */
export class CloudView {
  /** What the last turn of the cloud needed: points drawn and milliseconds. */
  readonly figures = { points: 0, drawn: 0, frame_ms: 0 };
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(35, 1, 1, 10000);
  private readonly controls: OrbitControls;
  private readonly geometry = new BufferGeometry();
  private readonly material = new PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: true });
  private order: Uint32Array = new Uint32Array();
  private readonly marker: Line;
  private readonly middle = new Vector3();
  private radius = 1;
  private drawn = FEWEST * 10;
  private shown = 0;
  private moved = 0;
  private last = 0;
  private dirty = true;
  private moving = false;
  private marked = false;
  private turning: boolean;
  private readonly begun = performance.now();
  private alive = true;
  private pointSize = 2;
  private readonly resized: ResizeObserver;

  /** Shows `cloud`, which turns by itself at first where `turns`. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private cloud: Cloud,
    turns = true,
  ) {
    this.turning = turns && !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.renderer = new WebGLRenderer({ canvas, preserveDrawingBuffer: true, powerPreference: "high-performance" });
    this.renderer.autoClear = false;
    this.scene.background = null;
    this.renderer.setClearColor(new Color(0x0b0e14));
    this.frame();
    this.place();
    this.marker = new Line(new BufferGeometry(), new LineBasicMaterial({ color: 0xffffff, depthTest: false }));
    this.marker.frustumCulled = false;
    this.marker.visible = false;
    const points = new Points(this.geometry, this.material);
    points.frustumCulled = false;
    this.scene.add(points, this.marker);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("start", () => (this.turning = false));
    this.controls.addEventListener("change", () => this.touched());
    this.resized = new ResizeObserver(() => this.resize());
    this.resized.observe(canvas.parentElement ?? canvas);
    this.resize();
    this.front();
    const loop = (now: number) => {
      if (!this.alive) return;
      this.step(now);
      requestAnimationFrame(loop);
    };
    requestAnimationFrame(loop);
  }

  /** Shows another cloud from where the operator looks now; from the front where it lies elsewhere. */
  replace(cloud: Cloud): void {
    const [middle, radius] = [this.middle.clone(), this.radius];
    this.cloud = cloud;
    this.mark([]);
    this.frame();
    const elsewhere = this.middle.distanceTo(middle) > radius || this.radius > 2 * radius || this.radius < radius / 4;
    if (!elsewhere) {
      this.middle.copy(middle);
      this.radius = radius;
    }
    // Frees what the driver holds of the cloud before.
    this.geometry.dispose();
    this.place();
    if (elsewhere) this.front();
    this.touched();
  }

  /** Finds where the cloud is and how large; an empty one is where the one before was. */
  private frame(): void {
    const { positions, count } = this.cloud;
    if (count === 0) return;
    const axis = (offset: number): [number, number] => {
      const values = new Float32Array(count);
      for (let index = 0; index < count; index++) values[index] = positions[index * 3 + offset];
      return quantiles(values, 0.01, 0.99);
    };
    const [x, y, z] = [axis(0), axis(1), axis(2)];
    this.middle.set((x[0] + x[1]) / 2, (y[0] + y[1]) / 2, (z[0] + z[1]) / 2);
    this.radius = Math.max(1e-3, Math.hypot(x[1] - x[0], y[1] - y[0], z[1] - z[0]) / 2);
  }

  /** Puts the points in the order of drawing, about the middle, with y and z turned as the screen has them. */
  private place(): void {
    const { positions, count } = this.cloud;
    this.order = spread(count);
    this.figures.points = count;
    this.shown = 0;
    const placed = new Float32Array(count * 3);
    for (let index = 0; index < count; index++) {
      const from = this.order[index] * 3;
      placed[index * 3] = positions[from] - this.middle.x;
      placed[index * 3 + 1] = this.middle.y - positions[from + 1];
      placed[index * 3 + 2] = this.middle.z - positions[from + 2];
    }
    this.geometry.setAttribute("position", new BufferAttribute(placed, 3));
    this.geometry.setAttribute("color", new BufferAttribute(new Uint8Array(count * 3), 3, true));
  }

  /** Colours the points, and says what the scale shows. */
  colour(by: Colouring): Legend {
    const { rgb, legend } = colours(this.cloud, by);
    const attribute = this.geometry.getAttribute("color") as BufferAttribute;
    const target = attribute.array as Uint8Array;
    for (let index = 0; index < this.cloud.count; index++) {
      const from = this.order[index] * 3;
      for (let channel = 0; channel < 3; channel++) target[index * 3 + channel] = toLinear[rgb[from + channel]];
    }
    attribute.needsUpdate = true;
    this.touched();
    return legend;
  }

  /** Size of a point in pixels of the screen. */
  size(pixels: number): void {
    this.pointSize = pixels;
    this.touched();
  }

  /** Looks from where the camera stood, a little from the side, and stays there. */
  reset(): void {
    this.turning = false;
    this.front();
  }

  private front(): void {
    const away = (this.radius / Math.sin((this.camera.fov * Math.PI) / 360)) * 0.8;
    this.controls.target.set(0, 0, 0);
    this.camera.position.set(away * 0.35, away * 0.2, away * 0.9);
    this.camera.near = away / 100;
    this.camera.far = away * 10;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.touched();
  }

  /** Turns the cloud by angles in degrees. */
  turn(across: number, down: number): void {
    this.turning = false;
    const offset = this.camera.position.clone().sub(this.controls.target);
    offset.applyAxisAngle(new Vector3(0, 1, 0), (across * Math.PI) / 180);
    const side = new Vector3().crossVectors(new Vector3(0, 1, 0), offset).normalize();
    const turned = offset.clone().applyAxisAngle(side, (down * Math.PI) / 180);
    if (turned.angleTo(new Vector3(0, 1, 0)) > 0.1 && turned.angleTo(new Vector3(0, -1, 0)) > 0.1) offset.copy(turned);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.touched();
  }

  /** Comes nearer (below 1) or goes away. */
  zoom(factor: number): void {
    this.turning = false;
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
    this.touched();
  }

  /** The point under a place of the canvas, in the camera's coordinates; `null` where there is none. */
  pointAt(x: number, y: number): Point | null {
    this.turning = false;
    const size = { width: this.canvas.clientWidth, height: this.canvas.clientHeight };
    this.camera.updateMatrixWorld();
    // From the camera's coordinates: y and z turn, then the middle moves to the origin.
    const toScreen = new Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
    const { x: mx, y: my, z: mz } = this.middle;
    toScreen.multiply(new Matrix4().set(1, 0, 0, -mx, 0, -1, 0, my, 0, 0, -1, mz, 0, 0, 0, 1));
    const index = pick(this.cloud.positions, toScreen.elements, size, { x, y }, 8);
    if (index < 0) return null;
    const { positions } = this.cloud;
    return [positions[index * 3], positions[index * 3 + 1], positions[index * 3 + 2]];
  }

  /** Draws a line through points; none removes it. */
  mark(points: Point[]): void {
    const placed = points.map(([x, y, z]) => new Vector3(x - this.middle.x, this.middle.y - y, this.middle.z - z));
    this.marked = placed.length > 0;
    if (placed.length === 1) {
      const arm = this.radius / 50;
      const [at] = placed;
      placed.push(at.clone().setX(at.x + arm), at.clone().setX(at.x - arm), at, at.clone().setY(at.y + arm), at.clone().setY(at.y - arm));
    }
    this.marker.geometry.dispose();
    this.marker.geometry = new BufferGeometry().setFromPoints(placed);
    this.touched();
  }

  /** Frees everything. */
  dispose(): void {
    this.alive = false;
    this.resized.disconnect();
    this.controls.dispose();
    this.geometry.dispose();
    this.marker.geometry.dispose();
    this.material.dispose();
    this.renderer.dispose();
  }

  private touched(): void {
    this.dirty = true;
    this.moved = performance.now();
  }

  private resize(): void {
    const parent = this.canvas.parentElement ?? this.canvas;
    const [width, height] = [Math.max(1, parent.clientWidth), Math.max(1, parent.clientHeight)];
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.touched();
  }

  private step(now: number): void {
    if (this.turning && now - this.begun > TURN_MS) this.turning = false;
    if (this.turning) {
      const offset = this.camera.position.clone().sub(this.controls.target);
      offset.applyAxisAngle(new Vector3(0, 1, 0), 0.004);
      this.camera.position.copy(this.controls.target).add(offset);
      this.camera.lookAt(this.controls.target);
      this.touched();
    }
    if (this.dirty) {
      // The way from picture to picture is what the operator sees, however the driver counts; pictures that only
      // complete a resting cloud are not meant.
      const took = now - this.last;
      if (this.moving) {
        this.drawn = budget(Math.min(this.drawn, this.cloud.count), took, this.cloud.count);
        this.figures.frame_ms = took;
      }
      this.moving = true;
      this.dirty = false;
      this.shown = Math.min(this.drawn, this.cloud.count);
      this.material.size = this.pointSize * growth(this.shown, this.cloud.count) * Math.min(devicePixelRatio, 2);
      this.renderer.clear();
      this.draw(0, this.shown, true);
    } else if (this.shown < this.cloud.count && now - this.moved > REST_MS) {
      this.moving = false;
      const first = this.shown === this.drawn ? 0 : this.shown;
      this.material.size = this.pointSize * Math.min(devicePixelRatio, 2);
      if (first === 0) this.renderer.clear();
      const more = Math.min(first === 0 ? Math.max(STRIDE, this.shown) : STRIDE, this.cloud.count - first);
      this.shown = first + more;
      this.draw(first, more, this.shown === this.cloud.count);
    } else {
      this.moving = false;
    }
    this.last = now;
    this.figures.drawn = this.shown;
    this.canvas.dataset.drawn = String(this.shown);
    this.canvas.dataset.frameMs = this.figures.frame_ms.toFixed(0);
  }

  private draw(first: number, points: number, marks: boolean): void {
    this.geometry.setDrawRange(first, points);
    this.marker.visible = marks && this.marked;
    this.renderer.render(this.scene, this.camera);
  }
}

/** Colours are given for the screen; the renderer reckons with light. */
const toLinear = Uint8Array.from({ length: 256 }, (_, value) => {
  const share = value / 255;
  return Math.round(255 * (share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4));
});
