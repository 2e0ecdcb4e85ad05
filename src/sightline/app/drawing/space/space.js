// A 3-D scene of named groups in a box, redrawn only on changes. Uses no framework.
//
// Mouse: left rotates, right or shift moves, wheel zooms. Touch: one finger rotates, two move and zoom.
// Keys: arrows rotate, with shift they move, + and - zoom. Up is always +Z.

import { COLOURS } from "colours";
import { CSS2DRenderer, OrbitControls, THREE } from "nicegui-scene";
import { dispose, make } from "space_objects";

/** @typedef {import("./types").Reach} Reach */
/** @typedef {import("./types").SpaceObject} SpaceObject */
/** @typedef {import("./types").Xyz} Xyz */
/** @typedef {[number, number]} Pair */
/** @typedef {import("nicegui-scene").CSS2DObject} CSS2DObject */

const FIELD_DEG = 30;
const TURN = Math.PI / 36; // of an arrow key
const NEARER = 1.15;
const HIDDEN = new Set(["views", "sights"]); // at first, because they hide wire and bone
const MAX_LINES = 4; // largest distance of a label from its place, in lines of text
/** @type {Reach[]} */
const REACHES = ["hip", "frame", "room"]; // each includes those before it
// Viewing directions for a left hip, with the feet towards -Y; for a right one they are towards +Y.
/** @type {Record<string, Xyz>} */
const FROM = { feet: [0, -1, 0], side: [1, 0, 0], above: [0, -0.001, 1], aslant: [0.3, -0.45, 0.841] };

const CSS = `
.space { position: absolute; inset: 0; overflow: hidden; font: 500 clamp(13px, 9px + 0.32vw, 22px) system-ui, sans-serif; background: var(--ground); }
.space canvas { display: block; touch-action: none; }
.space canvas:focus-visible { outline: 3px solid var(--sky); outline-offset: -3px; }
.space-labels { position: absolute; inset: 0; pointer-events: none; overflow: hidden; }
.space-label { font-weight: 600; white-space: nowrap; padding: 1px 5px; border-radius: 4px;
  background: rgba(14, 18, 23, 0.88); max-width: 20em; overflow: hidden; text-overflow: ellipsis; }
.space-bar { position: absolute; display: flex; flex-wrap: wrap; gap: 4px; padding: 6px; z-index: 1; }
.space-bar button { font: inherit; color: var(--text); background: rgba(34, 43, 53, 0.88);
  border: 1px solid var(--edge); border-radius: 6px; padding: 0.2em 0.7em; min-height: 2em; cursor: pointer; }
.space-bar button:hover { border-color: var(--sky); }
.space-bar button:focus-visible { outline: 3px solid var(--sky); }
.space-bar button[aria-pressed="false"] { color: var(--quiet); background: rgba(14, 18, 23, 0.88); text-decoration: line-through; }
.space-notes { position: absolute; left: 0; bottom: 0; margin: 0; padding: 0.3em 0.8em;
  color: var(--quiet); background: rgba(14, 18, 23, 0.88); pointer-events: none; }
.space-notes:empty { display: none; }
.space-none { position: absolute; inset: 0; display: grid; place-content: center; padding: 2em; text-align: center; }`;

/** @type {Record<string, Pair>} */
const MOVES = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
/** @type {Record<string, number>} */
const ZOOMS = { "+": 1 / NEARER, "=": 1 / NEARER, "-": NEARER };

export class SpaceCore {
  /** @param {HTMLElement} box @param {import("./types").SpaceOptions} options */
  constructor(box, { label, groups, texts }) {
    this.texts = texts;
    /** @type {Map<string, THREE.Group>} */
    this.groups = new Map();
    /** The plain objects that each group was made from.
     * @type {Record<string, SpaceObject[]>} */
    this.objects = {};
    this.names = groups; // name -> text in the legend
    this.renders = 0;
    this.asked = 0;
    this.feet = 1; // -1: towards +Y
    this.touched = false; // the person has chosen a view: keep it
    this.root = document.createElement("div");
    this.root.className = "space";
    box.append(this.root);
    if (!document.getElementById("space-css")) {
      document.head.append(Object.assign(document.createElement("style"), { id: "space-css", textContent: CSS }));
    }
    // Types of what `build` makes. It is missing where the browser has no WebGL: then nothing is drawn.
    /** @type {CSS2DRenderer} */ this.labels;
    /** @type {THREE.Scene} */ this.scene;
    /** @type {THREE.PerspectiveCamera} */ this.camera;
    /** @type {OrbitControls} */ this.controls;
    /** @type {HTMLElement} */ this.legend;
    /** @type {HTMLElement} */ this.notes;
    /** State of the legend as it was drawn last.
     * @type {string} */
    this.legendState;
    /** @type {THREE.WebGLRenderer | undefined} */
    this.renderer = undefined;
    try {
      this.renderer = new THREE.WebGLRenderer({ antialias: true });
    } catch {
      this.sayNone();
      return;
    }
    this.build(label, this.renderer.domElement);
  }

  sayNone() {
    const said = document.createElement("p");
    said.className = "space-none";
    said.textContent = this.texts.none;
    this.root.append(said);
  }

  /** @param {string} label @param {HTMLCanvasElement} canvas */
  build(label, canvas) {
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${label}. ${this.texts.keys}`);
    this.labels = new CSS2DRenderer();
    this.labels.domElement.className = "space-labels";
    this.root.append(canvas, this.labels.domElement);

    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(COLOURS.ground);
    this.camera = new THREE.PerspectiveCamera(FIELD_DEG, 1, 1, 10000);
    this.camera.up.set(0, 0, 1);
    const light = new THREE.DirectionalLight("#ffffff", 2.2);
    light.position.set(-1, 1.4, 1);
    this.camera.add(light); // over the viewer's shoulder
    this.scene.add(this.camera, new THREE.AmbientLight("#ffffff", 1.1));

    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.controls.addEventListener("start", () => (this.touched = true));
    this.pressed = (/** @type {KeyboardEvent} */ event) => this.key(event);
    canvas.addEventListener("keydown", this.pressed);
    canvas.addEventListener("webglcontextrestored", () => this.draw());
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(this.root);
    this.buildLooks();
    this.legend = this.bar("left: 0; top: 0; max-width: 60%");
    this.notes = document.createElement("p");
    this.notes.className = "space-notes";
    this.root.append(this.notes);
    this.look("aslant");
    this.resize();
  }

  /** @param {string} style */
  bar(style) {
    const made = document.createElement("div");
    made.className = "space-bar";
    made.style.cssText = style;
    this.root.append(made);
    return made;
  }

  /** @param {HTMLElement} bar @param {string} words @param {string} id @param {() => void} onClick */
  button(bar, words, id, onClick) {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = words;
    made.dataset.testid = id;
    made.addEventListener("click", onClick);
    bar.append(made);
    return made;
  }

  buildLooks() {
    const bar = this.bar("right: 0; top: 0; justify-content: flex-end; max-width: 40%");
    for (const from of ["feet", "side", "above"]) {
      this.button(bar, this.texts[from], `space-look-${from}`, () => this.chosen(() => this.look(from)));
    }
    for (const reach of REACHES) {
      this.button(bar, this.texts[reach], `space-fit-${reach}`, () => this.chosen(() => this.fit(reach)));
    }
  }

  /** @param {() => void} change */
  chosen(change) {
    this.touched = true;
    change();
  }

  // -------------------------------------------------------------------------------------------------------- content

  /** Replaces one group. Notes are shown as text below the scene.
   * @param {string} name @param {SpaceObject[]} objects */
  update(name, objects) {
    this.objects[name] = objects;
    if (!this.renderer) return;
    const before = this.groups.get(name);
    const group = new THREE.Group();
    group.visible = before ? before.visible : !HIDDEN.has(name);
    for (const object of objects) if (object.kind !== "note") group.add(make(object));
    if (before) {
      this.scene.remove(before);
      dispose(before);
    }
    this.groups.set(name, group);
    this.scene.add(group);
    this.drawLegend();
    this.drawNotes();
    if (!this.touched) this.fitFirst();
    this.draw();
  }

  /** @param {string} name @param {boolean} on */
  show(name, on) {
    const group = this.groups.get(name);
    if (!group) return;
    group.visible = on;
    this.drawLegend();
    this.drawNotes();
    this.draw();
  }

  drawLegend() {
    /** @type {[string, boolean][]} */
    const shown = [];
    for (const name of Object.keys(this.names)) {
      const group = this.groups.get(name);
      if (group?.children.length) shown.push([name, group.visible]);
    }
    const state = JSON.stringify(shown);
    if (state === this.legendState) return; // an unnecessary update would take the focus away
    this.legendState = state;
    const active = /** @type {HTMLElement | null} */ (document.activeElement);
    const focused = this.legend.contains(active) ? active?.dataset.testid : null;
    this.legend.replaceChildren();
    for (const [name, visible] of shown) {
      const made = this.button(this.legend, this.names[name], `space-show-${name}`, () => this.chosen(() => this.show(name, !visible)));
      made.setAttribute("aria-pressed", String(visible));
      if (made.dataset.testid === focused) made.focus();
    }
  }

  drawNotes() {
    const shown = Object.keys(this.objects).filter((name) => this.groups.get(name)?.visible);
    const notes = shown.flatMap((name) => this.objects[name].flatMap((one) => (one.kind === "note" ? [one.text] : [])));
    this.notes.textContent = notes.join(" · ");
  }

  // ---------------------------------------------------------------------------------------------------------- the camera

  /** Sets the side of the hip, "right" or other: the patient's feet are then towards the viewer, the head up.
   * @param {string | null} side */
  orient(side) {
    this.feet = side === "right" ? -1 : 1;
    if (!this.touched) this.look("aslant");
  }

  /** Sets the viewing direction; target and distance stay.
   * @param {string} from */
  look(from) {
    if (!this.renderer) return;
    const distance = this.camera.position.distanceTo(this.controls.target) || 1000;
    const towards = new THREE.Vector3(...FROM[from]).multiply(new THREE.Vector3(1, this.feet, 1)).normalize();
    this.camera.position.copy(this.controls.target).addScaledVector(towards, distance);
    this.controls.update();
    this.draw();
  }

  // Fits the view to wire and bone, without the frame, which stands before them; before there are any, to the frame.
  fitFirst() {
    const hip = this.fit("hip");
    const frame = this.groups.get("frame");
    if (frame) frame.visible = !hip;
    if (!hip) this.fit("frame");
    this.drawLegend();
  }

  /** Fits the view to the objects of the hip, the frame or the whole room. Returns false where there are none.
   * @param {Reach} reach */
  fit(reach) {
    if (!this.renderer) return false;
    const within = REACHES.slice(0, REACHES.indexOf(reach) + 1);
    const bounds = new THREE.Box3();
    for (const group of this.groups.values()) {
      if (!group.visible) continue;
      for (const made of group.children) {
        if (made.userData.reach && within.includes(made.userData.reach)) bounds.expandByObject(made);
      }
    }
    if (bounds.isEmpty()) return false;
    const ball = bounds.getBoundingSphere(new THREE.Sphere());
    const half = ((FIELD_DEG / 2) * Math.PI) / 180;
    const narrow = Math.min(1, this.camera.aspect);
    const fill = reach === "hip" ? 0.7 : 0.9; // of the ball around the box, which bone and wire do not fill
    const distance = (fill * Math.max(ball.radius, 10)) / Math.sin(half) / narrow;
    const from = this.camera.position.clone().sub(this.controls.target).normalize();
    this.controls.target.copy(ball.center);
    this.camera.position.copy(ball.center).addScaledVector(from, distance);
    this.controls.update();
    this.draw();
    return true;
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    const moves = MOVES[event.key];
    const zoom = ZOOMS[event.key];
    if ((!moves && !zoom) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    this.touched = true;
    const away = this.camera.position.clone().sub(this.controls.target);
    if (zoom) away.multiplyScalar(zoom);
    else if (event.shiftKey) this.shift(moves, away.length());
    else this.turn(moves, away);
    this.camera.position.copy(this.controls.target).add(away);
    this.controls.update();
    this.draw();
  }

  /** @param {Pair} direction @param {THREE.Vector3} away */
  turn([right, up], away) {
    const polar = new THREE.Spherical().setFromVector3(new THREE.Vector3(away.x, away.z, -away.y)); // its up is +y
    polar.theta += right * TURN;
    polar.phi = Math.min(Math.max(polar.phi - up * TURN, 0.01), Math.PI - 0.01);
    const turned = new THREE.Vector3().setFromSpherical(polar);
    away.set(turned.x, -turned.z, turned.y);
  }

  /** @param {Pair} direction @param {number} distance */
  shift([right, up], distance) {
    const step = 0.04 * distance;
    const across = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 0).multiplyScalar(right * step);
    const upwards = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 1).multiplyScalar(up * step);
    this.controls.target.add(across).add(upwards);
  }

  // ------------------------------------------------------------------------------------------------------------ drawing

  resize() {
    const { clientWidth: width, clientHeight: height } = this.root;
    if (!width || !height || !this.renderer) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height);
    this.labels.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (!this.touched) this.fitFirst();
    this.draw();
  }

  // Draws once in the next animation frame, however often it is called.
  draw() {
    this.asked ||= requestAnimationFrame(() => {
      this.asked = 0;
      if (!this.root.clientWidth || !this.root.clientHeight || !this.renderer) return; // hidden: `resize` draws when it is back
      this.renderer.render(this.scene, this.camera);
      this.labels.render(this.scene, this.camera);
      this.spreadLabels();
      this.renders += 1;
    });
  }

  // Moves labels up until none overlaps another, the nearest to the viewer first; hides those that would end far away.
  spreadLabels() {
    /** @type {{ x: number, top: number, width: number }[]} */
    const placed = [];
    /** @type {CSS2DObject[]} */
    const shown = [];
    this.scene.traverseVisible((made) => {
      if (made.isCSS2DObject) shown.push(/** @type {CSS2DObject} */ (made));
    });
    const depth = (/** @type {CSS2DObject} */ made) => made.getWorldPosition(new THREE.Vector3()).distanceTo(this.camera.position);
    shown.sort((a, b) => depth(a) - depth(b));
    for (const made of shown) {
      const [x, y] = this.toScreen(made.position.toArray());
      const size = (made.userData.size ??= [made.element.offsetWidth, made.element.offsetHeight]); // cached: reading it is slow
      let top = y - size[1] - 4;
      const covered = () => placed.find((o) => Math.abs(o.x - x) < (o.width + size[0]) / 2 && Math.abs(o.top - top) < size[1]);
      for (let other = covered(); other; other = covered()) top = other.top - size[1] - 1;
      const near = y - top < MAX_LINES * size[1];
      if (near) placed.push({ x, top, width: size[0] });
      made.element.style.visibility = near ? "visible" : "hidden";
      made.element.style.marginTop = `${top - y + size[1] / 2}px`;
    }
  }

  /** The position of a point in the box, CSS pixels.
   * @param {Xyz} xyz */
  toScreen(xyz) {
    const { x, y } = new THREE.Vector3(...xyz).project(this.camera);
    return [((x + 1) / 2) * this.root.clientWidth, ((1 - y) / 2) * this.root.clientHeight];
  }

  destroy() {
    cancelAnimationFrame(this.asked);
    this.watch?.disconnect();
    this.controls?.dispose();
    for (const group of this.groups.values()) dispose(group);
    this.renderer?.dispose();
    this.renderer?.forceContextLoss(); // browsers allow only a few contexts
    this.root.remove();
  }
}
