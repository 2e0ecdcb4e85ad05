// The X-ray view: an image with layers of shapes, and points that a person places and moves. Uses no framework.
//
// There is one canvas on the page, because each costs the browser a millisecond per frame; the image without marks is
// on another, off the page. Each is redrawn in an animation frame, and only on changes.
// Coordinates are image pixels (see xray_display.js); the person's actions go out through `emit`.
//
// `word` is the server's newest message, the complete content of the view. A person's action is drawn over it at once;
// when the server acknowledges it, `word` replaces it.

import { COLOURS } from "colours";
import { Age } from "./xray_age.js";
import { Chrome } from "./xray_chrome.js";
import { Display } from "./xray_display.js";
import { Gestures } from "./xray_gestures.js";
import { arrange, Labels, measureOn, paintTexts } from "./xray_labels.js";
import { paintLens } from "./xray_lens.js";
import { Matching } from "./xray_matching.js";
import { Moves } from "./xray_moves.js";
import { paintPoint, paintShape, shapeDistance, shapeFault, STYLES } from "./xray_paint.js";
import { fetchPixels, heldWindow, Picture } from "./xray_picture.js";
import { PointButtons } from "./xray_points.js";

const ZOOM_STEP = 1.25; // per key press
const TIP_REACH = 8; // CSS pixels
const FRAMES_KEPT = 2000;
const BREAK_MS = 250; // a longer gap between frames means that the person paused

export class XrayCore {
  // `emit(event)` gets every event, `keep(move | null)` the newest edit that the server has not acknowledged.
  constructor(root, { name, label, texts, emit, keep }) {
    this.root = root;
    this.name = name;
    this.texts = texts;
    this.emit = emit;
    this.display = new Display();
    this.moves = new Moves(emit, keep);
    this.state = {
      image: null, // {url, width, height, pixels}
      window: { centre: 0, width: 1 },
      inverted: false,
      linked: false, // all views of the page zoom together
      stale: false,
      maximised: false,
      tool: "pan",
      placing: null,
      selected: null,
      hovered: null,
      dragging: null,
      points: new Map(),
      layers: new Map(),
    };
    /** @type {any} */
    this.word = { version: 0, picture: null, display: null, points: [], placing: null };
    this.undone = { points: new Map(), placing: null, display: null }; // numbers of unacknowledged actions
    this.place = document.createComment("enlarged"); // marks the view's place in the page
    this.chrome = new Chrome(root, label, texts, this.#actions());
    this.stage = this.chrome.stage;
    this.contexts = {
      ground: document.createElement("canvas").getContext("2d", { alpha: false }),
      shown: this.chrome.canvas.getContext("2d", { alpha: false }),
    };
    this.picture = new Picture();
    this.matching = new Matching();
    this.lens = null; // {uv, at}: the pixel in the magnifier, and its position in the view
    this.pointer = null; // position of the pointer, CSS pixels in the view; null outside
    this.dirty = { table: false, image: true, overlay: true, readout: true };
    this.draws = { table: 0, image: 0, overlay: 0 };
    this.frames = []; // ms between consecutive frames
    this.lastFrame = 0;
    this.request = null;
    this.loading = null;
    this.asked = null; // the picture requested last; its pixels may not have arrived
    this.age = new Age((stale) => this.#showStale(stale));
    this.buttons = new PointButtons(this.chrome.points, (id) => this.select(id));
    this.gestures = new Gestures(this);
    this.observer = new ResizeObserver(() => this.#resize());
    this.observer.observe(this.stage);
    this.resized = () => this.#resize(); // on another screen the size in CSS pixels may stay the same
    window.addEventListener("resize", this.resized);
    this.#resize();
    this.#showState();
    window.sightlineXray = window.sightlineXray || {};
    window.sightlineXray[name] = this;
    emit({ type: "ready" });
  }

  destroy() {
    if (this.state.maximised) this.root.remove();
    this.observer.disconnect();
    window.removeEventListener("resize", this.resized);
    this.gestures.destroy();
    if (this.loading) this.loading.abort();
    this.age.end();
    cancelAnimationFrame(this.request);
    if (window.sightlineXray[this.name] === this) delete window.sightlineXray[this.name];
  }

  // ------------------------------------------------------------------------------------------------ server messages

  // Show this content; returns false if a newer message is known.
  show({ freshMs, ...word }) {
    if (word.version <= this.word.version) return false;
    this.word = word;
    this.chrome.setLabel(word.label);
    this.chrome.showLine(this.chrome.notice, word.notice);
    this.#showPicture(word.picture, freshMs);
    this.#showLayers(word.layers);
    this.matching.show(word.matching || null, this.#layerShapes(), (message) => this.#report(message));
    this.#showDisplay();
    this.#mergePoints();
    this.#showPlacing();
    this.#showState();
    return true;
  }

  // The action of this number is acknowledged: `word` replaces it.
  acknowledge(seq) {
    const { undone } = this;
    for (const [id, number] of [...undone.points]) if (number === seq) undone.points.delete(id);
    if (undone.placing === seq) undone.placing = null;
    if (undone.display === seq) undone.display = null;
    this.moves.acknowledge(seq);
    this.release();
    this.#showPlacing();
  }

  // Discard unacknowledged actions.
  giveUp() {
    this.undone = { points: new Map(), placing: null, display: null };
    this.release();
    this.#showPlacing();
  }

  // Raw little-endian uint16, `width * height` of them, from `url`; the newest picture wins.
  async #showPicture(picture, freshMs) {
    const url = picture && picture.url;
    this.setFresh(url, freshMs);
    if (JSON.stringify(picture) === JSON.stringify(this.asked)) return;
    if (this.loading) this.loading.abort();
    if (url !== this.url) this.#letGo();
    this.asked = picture;
    this.loading = null;
    if (picture === null) return this.#takeImage(null);
    const loading = (this.loading = new AbortController());
    try {
      const pixels = await fetchPixels(url, picture.width, picture.height, loading.signal);
      if (this.loading === loading) this.loading = null;
      this.#takeImage({ ...picture, pixels });
    } catch (error) {
      if (loading.signal.aborted) return;
      if (this.loading === loading) this.loading = null;
      this.#takeImage(null); // an old image under a new plan would mislead
      this.chrome.showLine(this.chrome.fault, this.texts.load_failed);
      this.#report(error instanceof Error ? error.message : String(error));
    }
  }

  // Layers by name, drawn in this order.
  #showLayers(layers) {
    this.state.layers.clear();
    for (const [name, shapes] of Object.entries(layers)) {
      const faults = shapes.map(shapeFault).filter(Boolean);
      if (faults.length) this.#report(`layer ${name}: ${faults[0]}`);
      this.state.layers.set(name, { shapes: faults.length ? shapes.filter((shape) => !shapeFault(shape)) : shapes });
    }
    const ticks = this.#layerShapes().some(({ shape }) => shape === "ticks");
    this.chrome.showLine(this.chrome.legend, ticks ? this.texts.ticks : "");
    this.invalidate("overlay");
  }

  // The points of `word`; a point being dragged, or moved and not acknowledged, keeps its position.
  #mergePoints() {
    const before = this.state.points;
    this.state.points = new Map(this.word.points.map((point) => [point.id, this.#point(point, before.get(point.id))]));
    for (const id of before.keys()) if (!this.state.points.has(id)) this.#dropPoint(id);
    this.#showPoints();
    this.invalidate("overlay");
  }

  // The next click places this point; null: none.
  #showPlacing() {
    const id = this.undone.placing === null ? this.word.placing : null;
    if (id === this.state.placing) return;
    this.state.placing = id;
    if (id === null) this.lens = null;
    this.chrome.showLine(this.chrome.hint, id === null ? "" : this.texts.placing.replace("{name}", this.#nameOf(id)));
    this.gestures.showCursor();
    this.invalidate("overlay");
  }

  // How the image is drawn; the window waits for the pixels it belongs to.
  #showDisplay() {
    const { display } = this.word;
    if (display === null || this.undone.display !== null || this.gestures.changesWindow) return;
    const { rotation, mirrored, inverted, window: shown } = display;
    if (rotation !== this.display.rotation || mirrored !== this.display.mirrored) {
      this.display.orient(rotation, mirrored);
      this.#turned();
    }
    if (this.loading) return;
    const [held, now] = [heldWindow(shown), this.state.window];
    if (held.centre !== now.centre || held.width !== now.width) this.setWindow(held);
    if (inverted !== this.state.inverted) this.#setInverted(inverted);
  }

  // The image at `url` is current for `ms`, unless extended; null: it does not expire.
  setFresh(url, ms) {
    this.age.extend(url, ms, this.shownUrl);
  }

  // Freshness is no longer reported.
  loseTouch() {
    this.age.loseTouch();
  }

  // ------------------------------------------------------------------------------------------------ person's actions

  setWindow(shown) {
    this.state.window = heldWindow(shown);
    this.invalidate("table");
  }

  movedView() {
    this.invalidate("image", "overlay", "readout");
    if (this.state.linked) for (const view of this.#others()) view.zoomAlong(this.display);
  }

  // Another view has this zoom: the selected point stays in its place, or else the middle.
  zoomAlong(display) {
    if (this.display.follow(display, this.#selectedPlace())) this.invalidate("image", "overlay", "readout");
  }

  zoom(inwards) {
    const middle = [this.display.viewWidth / 2, this.display.viewHeight / 2];
    const at = document.activeElement === this.stage ? middle : this.#selectedPlace();
    this.display.zoomAt(inwards ? ZOOM_STEP : 1 / ZOOM_STEP, at);
    this.movedView();
  }

  #selectedPlace() {
    const point = this.state.points.get(this.state.selected);
    return point && point.uv ? this.display.toView(point.uv) : [this.display.viewWidth / 2, this.display.viewHeight / 2];
  }

  #others() {
    return Object.values(window.sightlineXray).filter((view) => view !== this);
  }

  #link(on) {
    for (const view of Object.values(window.sightlineXray)) {
      view.state.linked = on;
      view.chrome.press("link", on);
    }
    this.movedView();
  }

  displayChanged() {
    const { rotation, mirrored } = this.display;
    const { inverted, window: shown } = this.state;
    const seq = (this.undone.display = this.moves.number());
    this.emit({ type: "display", image: this.shownUrl, seq, rotation, mirrored, inverted, window: { ...shown } });
  }

  select(id) {
    if (this.state.selected === id) return;
    this.state.selected = id;
    this.emit({ type: "select", id });
    this.invalidate("overlay");
  }

  // The point under the pointer, or null: its name is shown.
  hover(id) {
    if (this.state.hovered === id) return;
    this.state.hovered = id;
    this.invalidate("overlay");
  }

  // Draws the point at once; `type` tells the server the action: place, drag, drop or nudge.
  move(type, id, uv) {
    if (!this.#onItsImage) return this.release();
    const point = this.state.points.get(id);
    point.uv = this.display.clamp(point.slides || (point.snapped && type !== "place") ? this.slid(id, uv) : uv);
    this.undone.points.set(id, this.moves.push(type, id, point.uv, this.shownUrl));
    if (type !== "drag") this.#settled(point);
    this.invalidate("overlay");
    for (const follower of this.#followers()) follower.follow(id);
  }

  // Ends the current gesture without a message to the server.
  release() {
    this.#showDisplay();
    this.#mergePoints();
    for (const follower of this.#followers()) follower.settle();
  }

  // ------------------------------------------------------------------------------- points that move in another view

  // The place on the point's image-matching curve nearest to `uv`; `uv` itself where it has none.
  slid(id, uv) {
    const point = this.#leader && this.#leader.state.points.get(id);
    return this.matching.onCurve(id, point ? point.uv : null, uv);
  }

  // A point has moved in the other view: its curve moves, and with it the point, if it lies on that.
  follow(id) {
    const [leader, point] = [this.#leader, this.state.points.get(id)];
    const before = leader.word.points.find((one) => one.id === id);
    if (point && point.uv && point.snapped && before && before.uv) {
      point.uv = this.matching.slid(id, point.uv, before.uv, leader.state.points.get(id).uv);
    }
    this.invalidate("overlay");
  }

  // Points that move no longer in the other view are where the newest message has them.
  settle() {
    const moving = this.#moving;
    for (const id of this.state.points.keys()) if (!moving.has(id)) this.matching.rest(id);
    this.#mergePoints();
  }

  // The view whose points' curves are drawn here; null: none.
  get #leader() {
    const { word } = this.matching;
    return (word && window.sightlineXray[word.from]) || null;
  }

  #followers() {
    return Object.values(window.sightlineXray).filter(({ matching }) => matching.word && matching.word.from === this.name);
  }

  // Points that the person moves in the other view, and where they are there.
  get #moving() {
    const leader = this.#leader;
    return leader ? leader.moved : new Map();
  }

  // Points whose place here is not the server's word, and that place.
  get moved() {
    const points = [...this.state.points.values()].filter(({ id, uv }) => uv && this.#held(id));
    return new Map(points.map(({ id, uv }) => [id, uv]));
  }

  remove(id) {
    this.emit({ type: "remove", id, image: this.shownUrl });
  }

  // The address of the image on the screen; null: none.
  get shownUrl() {
    return this.state.image && this.state.image.url;
  }

  // Size of the picture requested last.
  get url() {
    return this.asked && this.asked.url;
  }

  // Points can be placed and moved only over the image of the newest message.
  get #onItsImage() {
    return this.state.image !== null && this.shownUrl === this.url;
  }

  // The click that places a point.
  placeAt(place) {
    const id = this.state.placing;
    if (id === null || !this.#onItsImage) return;
    const uv = this.aimed(place);
    if (!this.display.contains(uv)) {
      this.chrome.showLine(this.chrome.lost, this.texts.off_field);
      return;
    }
    this.move("place", id, uv);
    this.undone.placing = this.undone.points.get(id);
    this.#showPlacing();
    this.select(id);
  }

  // Where a click at `uv` places the point: on its curve, if it slides there.
  aimed(uv) {
    const point = this.state.points.get(this.state.placing);
    return point && point.slides ? this.slid(point.id, uv) : uv;
  }

  cancelPlacing() {
    const id = this.state.placing;
    const seq = (this.undone.placing = this.moves.number());
    this.#showPlacing();
    this.emit({ type: "cancel", id, seq });
  }

  // Repeats an edit made before the connection broke; returns false if its point is gone.
  resend({ type, id, uv }) {
    if (!this.state.points.has(id)) return false;
    this.state.points.get(id).uv = uv;
    this.undone.points.set(id, this.moves.push(type, id, uv, this.url));
    this.#showPoints();
    this.invalidate("overlay");
    return true;
  }

  sayLost(id) {
    this.chrome.showLine(this.chrome.lost, this.texts.edit_lost.replace("{name}", this.#nameOf(id)));
  }

  // -------------------------------------------------------------------------------------------------- positions

  toScreen(uv) {
    const box = this.stage.getBoundingClientRect();
    const [x, y] = this.display.toView(uv);
    return [x + box.left, y + box.top];
  }

  toImage([x, y]) {
    const box = this.stage.getBoundingClientRect();
    return this.display.toImage([x - box.left, y - box.top]);
  }

  // The nearest placed point within `reach` CSS pixels of a position in the view.
  pointAt(at, reach) {
    let best = null;
    let least = reach;
    for (const point of this.state.points.values()) {
      if (!point.uv) continue;
      const [x, y] = this.display.toView(point.uv);
      const away = Math.hypot(x - at[0], y - at[1]);
      if (away <= least) [best, least] = [point, away];
    }
    return best;
  }

  // The title of the shape at a position in the view.
  titleAt(at) {
    let title = "";
    let least = TIP_REACH * this.unit;
    for (const shape of this.#shownShapes()) {
      if (!shape.title || (this.state.stale && STYLES[shape.style].plan)) continue;
      const away = shapeDistance(shape, (uv) => this.display.toView(uv), this.display.zoom, at);
      if (away < least) [title, least] = [String(shape.title), away];
    }
    return title;
  }

  // Grey value of the pixel at (u, v); null outside the image.
  valueAt([u, v]) {
    const { image } = this.state;
    const [column, row] = [Math.round(u), Math.round(v)];
    if (!image || column < 0 || row < 0 || column >= image.width || row >= image.height) return null;
    return image.pixels[row * image.width + column];
  }

  describe(point) {
    const [u, v] = point.uv.map((value) => value.toFixed(1));
    const place = this.texts.point.replace("{name}", point.label).replace("{u}", u).replace("{v}", v);
    return point.snapped ? `${place}, ${this.texts.snapped}` : place;
  }

  // ---------------------------------------------------------------------------------------------------------- drawing

  invalidate(...parts) {
    for (const part of parts) this.dirty[part] = true;
    if (this.request === null) this.request = requestAnimationFrame((now) => this.#frame(now));
  }

  #frame(now) {
    this.request = null;
    const since = now - this.lastFrame;
    this.lastFrame = now;
    if (since < BREAK_MS) this.frames.push(since);
    if (this.frames.length > FRAMES_KEPT) this.frames.splice(0, FRAMES_KEPT / 2);
    const { table, image, overlay, readout } = this.dirty;
    this.dirty = { table: false, image: false, overlay: false, readout: false };
    if (table) this.#drawTable();
    if (image || table) this.#drawImage();
    if (image || table || overlay) this.#drawOverlay();
    if (readout || table) this.#showReadout();
  }

  #drawTable() {
    const { image, inverted, window: shown } = this.state;
    if (!image) return;
    this.draws.table++;
    this.picture.draw(image, shown, inverted);
  }

  #drawImage() {
    this.draws.image++;
    const context = this.contexts.ground;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = COLOURS.stage;
    context.fillRect(0, 0, context.canvas.width, context.canvas.height);
    const middle = [this.display.viewWidth / 2, this.display.viewHeight / 2];
    this.#paintBitmap(context, this.display.centre, middle, 1);
  }

  // Draws the image with `uv` at position `at` of the view (CSS pixels), magnified `times` over the display's zoom.
  #paintBitmap(context, uv, at, times) {
    if (!this.state.image) return;
    const linear = this.display.linear().map((number) => number * times);
    this.picture.paint(context, linear, uv, at, this.density);
  }

  #drawOverlay() {
    this.draws.overlay++;
    const context = this.contexts.shown;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(this.contexts.ground.canvas, 0, 0);
    this.#toUnits(context);
    const toUnits = (uv) => this.display.toView(uv).map((value) => value / this.unit);
    this.#paintMarks(context, toUnits, this.display.zoom / this.unit, null);
    this.#paintTexts(context, toUnits);
    if (this.lens) this.#drawLens(context);
    this.stage.classList.toggle("xray-lens", this.lens !== null); // the focus ring would cover the magnifier
    if (!this.lens) this.buttons.place((id) => this.display.toView(this.state.points.get(id).uv)); // the magnifier hides them
  }

  #toUnits(context) {
    const [sx, sy] = this.density;
    context.setTransform(sx * this.unit, 0, 0, sy * this.unit, 0, 0);
  }

  // Without texts: those are painted once, and not in the magnifier.
  #paintMarks(context, toUnits, zoom, without) {
    for (const shape of this.#shownShapes()) {
      paintShape(context, shape, toUnits, zoom, this.state.stale, this.#colourOf(shape));
    }
    for (const point of this.#placed()) {
      if (point.id !== without) paintPoint(context, point, toUnits(point.uv), point.id === this.state.selected);
    }
    const aiming = this.state.points.get(this.state.placing);
    if (aiming && aiming.slides && this.lens && !without) {
      paintPoint(context, { ...aiming, snapped: true }, toUnits(this.lens.uv), true); // it slides on its curve
    }
  }

  #paintTexts(context, toUnits) {
    const { stale, selected, hovered, dragging } = this.state;
    const [width, height] = [this.display.viewWidth / this.unit, this.display.viewHeight / this.unit];
    const labels = new Labels(measureOn(context), [width, height - 15 * this.chrome.footEm]);
    const shapes = this.#shownShapes().filter(({ style }) => !stale || !STYLES[style].plan);
    arrange(
      labels,
      shapes.map((shape) => [shape, shape.points.map(toUnits)]),
      this.#placed().map((point) => [point, toUnits(point.uv)]),
      new Set([selected, hovered, dragging]),
      (id) => this.#curveOf(id),
    );
    paintTexts(context, labels.texts);
  }

  #placed() {
    return [...this.state.points.values()].filter((point) => point.uv);
  }

  // A curve has the name and the colour of its point, ticks are all alike.
  #curveOf(id) {
    const point = this.state.points.get(id);
    return point ? { name: point.label, colour: STYLES[point.style].colour } : null;
  }

  #colourOf({ of, shape }) {
    return of === undefined || shape === "ticks" ? null : (this.#curveOf(of) || { colour: null }).colour;
  }

  #drawLens(context) {
    paintLens(context, this.lens, this.display, this.unit, {
      bitmap: (uv, at, times) => this.#paintBitmap(context, uv, at, times),
      units: () => this.#toUnits(context),
      marks: (toUnits, zoom) => this.#paintMarks(context, toUnits, zoom, this.state.dragging),
    });
  }

  #layerShapes() {
    return [...this.state.layers.values()].flatMap((layer) => layer.shapes);
  }

  #shownShapes() {
    return this.matching.over(this.#layerShapes(), this.#moving);
  }

  // ------------------------------------------------------------------------------------------------------------ inside

  #actions() {
    return {
      fit: () => this.#changeView(() => this.display.fit()),
      link: () => this.#link(!this.state.linked),
      window: () => this.#setTool(this.state.tool === "window" ? "pan" : "window"),
      invert: () => this.#changeDisplay(() => this.#setInverted(!this.state.inverted)),
      flip: () => this.#changeDisplay(() => this.display.flip()),
      rotate: () => this.#changeDisplay(() => this.display.turnClockwise()),
      preset: (shown) => this.#changeDisplay(() => this.setWindow(shown)),
      reset: () => this.#changeDisplay(() => this.#reset()),
      maximise: () => this.maximise(!this.state.maximised),
    };
  }

  // Moved to the top level of the page: within its own box, later elements would cover it.
  maximise(on) {
    if (on === this.state.maximised) return;
    const focused = /** @type {HTMLElement} */ (document.activeElement);
    if (on) {
      this.root.replaceWith(this.place);
      document.body.append(this.root);
    } else {
      this.place.replaceWith(this.root);
    }
    if (this.root.contains(focused)) focused.focus({ preventScroll: true }); // a moved element loses the focus
    this.state.maximised = on;
    this.root.classList.toggle("xray-maximised", on);
    this.chrome.relabel("maximise", on ? "restore" : "maximise");
    this.chrome.press("maximise", on);
  }

  #changeView(change) {
    change();
    this.movedView();
  }

  #changeDisplay(change) {
    change();
    this.#turned();
    this.displayChanged();
  }

  #turned() {
    this.#showState();
    this.movedView();
  }

  #reset() {
    this.display.orient((360 - (this.word.head ?? 0)) % 360, false);
    this.display.fit();
    if (this.asked) this.setWindow(this.asked.window);
    this.#setInverted(false);
  }

  #setInverted(on) {
    this.state.inverted = on;
    this.invalidate("table");
    this.#showState();
  }

  #setTool(tool) {
    this.state.tool = tool;
    this.#showState();
    this.gestures.showCursor();
  }

  // The window; null: none.
  #takeImage(image) {
    this.state.image = image;
    if (image !== null) {
      this.age.arrived(image.url);
      this.display.setImage(image);
      this.#showDisplay();
      this.chrome.showLine(this.chrome.fault, "");
    }
    this.invalidate("table", "image", "overlay", "readout");
  }

  // Hides the plan while the image is out of date.
  #showStale(stale) {
    this.state.stale = stale;
    this.chrome.showLine(this.chrome.stale, stale ? this.texts.stale : "");
    this.invalidate("overlay");
  }

  // Another image ends the gesture on the one before.
  #letGo() {
    const [held, waiting] = [this.gestures.leaveImage(), this.moves.abandon()];
    this.undone = { points: new Map(), placing: null, display: null };
    if (held !== null || waiting !== null) this.sayLost(held ?? waiting);
  }

  // A move has ended: announce its position to screen readers, and clear the notice of an earlier loss.
  #settled(point) {
    this.#showPoints();
    this.chrome.say(this.describe(point));
    this.chrome.showLine(this.chrome.lost, "");
  }

  #point({ id, label, uv, style, movable, snapped, slides }, before) {
    if (!STYLES[style]) this.#report(`point ${id}: unknown style ${JSON.stringify(style)}`);
    return {
      id,
      label: label || id,
      uv: before && (this.#held(id) || (snapped && this.#moving.has(id))) ? before.uv : uv || null,
      style: STYLES[style] ? style : "aid",
      movable: movable !== false,
      snapped: Boolean(snapped),
      slides: Boolean(slides),
    };
  }

  #held(id) {
    return this.state.dragging === id || this.undone.points.has(id);
  }

  #dropPoint(id) {
    this.moves.forget(id);
    this.undone.points.delete(id);
    if (this.state.dragging === id) this.gestures.letGo();
    for (const what of ["selected", "hovered"]) if (this.state[what] === id) this.state[what] = null;
  }

  #nameOf(id) {
    const point = this.state.points.get(id);
    return point ? point.label : id;
  }

  #showPoints() {
    this.buttons.show(this.#placed(), (point) => this.describe(point));
  }

  focusPoint(id) {
    this.buttons.focus(id);
  }

  #showReadout() {
    const uv = this.pointer && this.display.toImage(this.pointer);
    const value = uv && this.valueAt(uv);
    const off = value === null || value === undefined || value === "";
    const [u, v] = uv ? uv.map((number) => number.toFixed(1)) : ["", ""];
    const text = this.texts.readout.replace("{u}", u).replace("{v}", v).replace("{value}", String(value));
    this.chrome.showText(this.chrome.readout, off ? this.texts.outside : text);
    this.#showState();
  }

  #showState() {
    const { mirrored } = this.display;
    const { window: shown, inverted, tool } = this.state;
    const turned = [this.#orientation(), mirrored ? this.texts.mirrored : ""];
    this.chrome.showState(
      `C ${Math.round(shown.centre)}  W ${Math.round(shown.width)}  ×${this.display.zoom.toFixed(2)}`,
      turned.filter(Boolean).join(", "),
      turned.every((text) => !text || text === this.texts.head_up),
    );
    this.chrome.press("window", tool === "window");
    this.chrome.press("invert", inverted);
    this.chrome.press("flip", mirrored);
    const { asked } = this;
    this.chrome.showPresets((asked && asked.presets) || {}, shown);
  }

  // Where the head is on the screen; where that is unknown, how far the image is rotated.
  #orientation() {
    const { rotation, mirrored } = this.display;
    const { head = null } = this.word;
    if (head === null) return rotation ? this.texts.rotated.replace("{degrees}", String(rotation)) : "";
    const at = ((mirrored ? 360 - head : head) + rotation) % 360;
    return this.texts[["head_up", "head_right", "head_down", "head_left"][at / 90]];
  }

  #report(message) {
    this.emit({ type: "error", message });
  }

  #resize() {
    const { clientWidth, clientHeight } = this.stage;
    const ratio = window.devicePixelRatio || 1;
    const [wide, high] = [Math.max(Math.round(clientWidth * ratio), 1), Math.max(Math.round(clientHeight * ratio), 1)];
    for (const { canvas } of Object.values(this.contexts)) {
      canvas.width = wide;
      canvas.height = high;
    }
    this.density = [wide / Math.max(clientWidth, 1), high / Math.max(clientHeight, 1)];
    this.unit = parseFloat(getComputedStyle(this.root).fontSize) / 15; // marks scale with the text size
    this.display.setView(clientWidth, clientHeight);
    this.gestures.viewChanged();
    this.movedView();
  }
}
