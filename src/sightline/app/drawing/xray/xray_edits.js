// The points of a view: where the server has them, and over that what the person does until it is acknowledged.

import { STYLES } from "./xray_paint.js";

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Point} Point */
/** @typedef {import("./types").PointSent} PointSent */
/** @typedef {import("./types").Placed} Placed */
/** @typedef {import("./types").Move} Move */

// Where the focus follows the request to its image from: the other image, and what asks for a point.
const ASKED_FROM = ".xray, .pick, .lead, .say";

export class Edits {
  /** `keep(move | null)` gets the newest edit that the server has not acknowledged.
   * @param {import("./xray.js").XrayCore} core
   * @param {(move: Move | null) => void} keep */
  constructor(core, keep) {
    this.core = core;
    this.moves = new Moves(core.emit, keep);
    this.undone = nothingUndone();
    /** @type {string | null} */
    this.clamped = null; // the point that the last move held at the edge of the field
  }

  /** The action of this number is acknowledged.
   * @param {number} seq */
  acknowledge(seq) {
    const { undone } = this;
    for (const [id, number] of [...undone.points]) if (number === seq) undone.points.delete(id);
    if (undone.placing === seq) undone.placing = null;
    this.moves.acknowledge(seq);
  }

  /** Discards unacknowledged actions. */
  giveUp() {
    this.undone = nothingUndone();
    /** @type {string | null} */
    this.clamped = null; // the point that the last move held at the edge of the field
  }

  /** The points of the newest message; a point being dragged, or moved and not acknowledged, keeps its position. */
  merge() {
    const { state, word, canvas } = this.core;
    const before = state.points;
    state.points = new Map(word.points.map((point) => [point.id, this.#point(point, before.get(point.id))]));
    for (const id of before.keys()) if (!state.points.has(id)) this.#drop(id);
    const chosen = this.core.point(state.selected);
    if (chosen && !chosen.movable && before.get(chosen.id)?.movable) this.core.select(null); // nothing acts on it now
    this.#showPoints();
    canvas.invalidate("overlay");
  }

  /** The next click places the message's point, if any. */
  showPlacing() {
    const { core } = this;
    const id = this.undone.placing === null ? core.word.placing : null;
    if (id === core.state.placing) return;
    core.state.placing = id;
    core.crosshair.end();
    if (id === null) core.lens = null;
    else if (document.activeElement?.closest(ASKED_FROM)) core.stage.focus({ preventScroll: true });
    const { chrome, texts } = core;
    chrome.showLine(chrome.hint, id === null ? "" : texts.placing.replace("{name}", this.#nameOf(id)));
    core.gestures.showCursor();
    core.canvas.invalidate("overlay");
  }

  /** Draws the point at once; `type` tells the server the action: place, drag, drop or nudge.
   * @param {string} type
   * @param {string} id
   * @param {Pair} uv */
  move(type, id, uv) {
    const { core } = this;
    const point = core.point(id);
    if (!point || !this.#onItsImage) return core.release();
    const onCurve = point.slides || (point.snapped && type !== "place");
    const wanted = onCurve ? core.following.slid(id, uv) : uv;
    point.uv = core.display.clamp(wanted);
    if (type !== "drop") this.clamped = core.display.contains(wanted) ? null : id; // a drop is where the drag held it
    this.undone.points.set(id, this.moves.push(type, id, point.uv, core.shownUrl));
    if (type !== "drag") this.#settled(/** @type {Placed} */ (point));
    if (this.clamped === id) core.chrome.showLine(core.chrome.lost, core.texts.held_in_field);
    core.canvas.invalidate("overlay");
    for (const follower of core.following.followers) follower.follow(id);
  }

  /** The click that places a point.
   * @param {Pair} place */
  placeAt(place) {
    const { core } = this;
    const id = core.state.placing;
    if (id === null || !this.#onItsImage) return;
    const uv = this.aimed(place);
    if (!core.display.contains(uv)) {
      core.chrome.showLine(core.chrome.lost, core.texts.off_field);
      return;
    }
    this.move("place", id, uv);
    this.undone.placing = this.undone.points.get(id) ?? null;
    this.showPlacing();
    core.select(id);
  }

  /** Where a click at `uv` places the point: on its curve, if it slides there.
   * @param {Pair} uv */
  aimed(uv) {
    const point = this.core.point(this.core.state.placing);
    return point?.slides ? this.core.following.slid(point.id, uv) : uv;
  }

  cancelPlacing() {
    const id = this.core.state.placing;
    const seq = (this.undone.placing = this.moves.number());
    this.showPlacing();
    this.core.emit({ type: "cancel", id, seq });
  }

  /** @param {string} id */
  remove(id) {
    this.core.emit({ type: "remove", id, image: this.core.shownUrl });
  }

  /** Repeats an edit made before the connection broke; returns false if its point is gone.
   * @param {Move} move */
  resend({ type, id, uv }) {
    const point = this.core.point(id);
    if (!point) return false;
    point.uv = uv;
    this.undone.points.set(id, this.moves.push(type, id, uv, this.core.url));
    this.#showPoints();
    this.core.canvas.invalidate("overlay");
    return true;
  }

  /** @param {string} id */
  sayLost(id) {
    const { chrome, texts } = this.core;
    chrome.showLine(chrome.lost, texts.edit_lost.replace("{name}", this.#nameOf(id)));
  }

  /** Points whose place here is not the server's word, and that place.
   * @returns {Map<string, Pair>} */
  get moved() {
    return new Map(this.core.placed.filter(({ id }) => this.#held(id)).map(({ id, uv }) => [id, uv]));
  }

  // Points can be placed and moved only over the image of the newest message.
  get #onItsImage() {
    return this.core.state.image !== null && this.core.shownUrl === this.core.url;
  }

  /** A move has ended: announce its position to screen readers, and clear the notice of an earlier loss.
   * @param {Placed} point */
  #settled(point) {
    const { chrome, reading } = this.core;
    this.#showPoints();
    chrome.say(reading.describe(point));
    chrome.showLine(chrome.lost, "");
  }

  /** @type {(sent: PointSent, before: Point | undefined) => Point} */
  #point({ id, label, uv, style, movable, snapped, slides }, before) {
    if (!STYLES[style]) this.core.report(`point ${id}: unknown style ${JSON.stringify(style)}`);
    const keeps = this.#held(id) || (snapped && this.core.following.moving.has(id));
    return {
      id,
      label: label || id,
      uv: before && keeps ? before.uv : uv || null,
      style: STYLES[style] ? style : "aid",
      movable: movable !== false,
      snapped: Boolean(snapped),
      slides: Boolean(slides),
    };
  }

  /** @param {string} id */
  #held(id) {
    return this.core.state.dragging === id || this.undone.points.has(id);
  }

  /** @param {string} id */
  #drop(id) {
    const { state, gestures } = this.core;
    this.moves.forget(id);
    this.undone.points.delete(id);
    if (state.dragging === id) gestures.letGo();
    if (state.selected === id) state.selected = null;
    if (state.hovered === id) state.hovered = null;
  }

  /** @param {string} id */
  #nameOf(id) {
    return this.core.point(id)?.label ?? id;
  }

  #showPoints() {
    this.core.buttons.show(this.core.placed, (point) => this.core.reading.describe(point));
  }
}

/** Numbers of actions that are not acknowledged.
 * @returns {{ points: Map<string, number>, placing: number | null }} */
const nothingUndone = () => ({ points: new Map(), placing: null });

// Sends moves of points to the server: one drag or nudge in flight, and the newest of each point wins.
//
// Unlimited messages would queue behind a slow computation. A second drag in flight would wait at the server as long as
// the first is computed, while the hand moves on: its figures would be twice as old.
// The last message of a gesture does not wait: an undo that overtook it would undo something else.
const PATIENCE_MS = 2000; // [ours] a later answer counts as lost: much longer than a computation, short for a person
const EDITS = new Set(["place", "drop", "nudge"]); // completed actions; a drag is still in progress
const ONCE = new Set(["place", "drop"]);

export class Moves {
  /** `send(move)` sends to the server; `keep(move | null)` stores the newest unacknowledged edit.
   * @param {(move: Move) => void} send
   * @param {(move: Move | null) => void} keep */
  constructor(send, keep) {
    this.send = send;
    this.keep = keep;
    this.seq = 0;
    /** @type {Map<number, number>} */
    this.inFlight = new Map(); // sent and not acknowledged: timers by number
    /** @type {Move | null} */
    this.kept = null;
    /** @type {Map<string, Move>} */
    this.waiting = new Map(); // by point: a newer move replaces an older one
  }

  // An unused number.
  number() {
    return ++this.seq;
  }

  /** Returns the move's number. `image`: address of its image; the server refuses moves for another image.
   * @param {string} type
   * @param {string} id
   * @param {Pair} uv
   * @param {string | null} image */
  push(type, id, uv, image) {
    /** @type {Move} */
    const move = { type, id, uv: [...uv], image, seq: this.number() };
    this.waiting.delete(id); // the newest goes to the end of the queue
    this.waiting.set(id, move);
    if (EDITS.has(type)) this.#hold(move);
    if (ONCE.has(type)) this.#send(move);
    else this.#next();
    return move.seq;
  }

  // Send what waits before the person's next action.
  flush() {
    for (const move of this.waiting.values()) if (EDITS.has(move.type)) this.#send(move);
  }

  /** The server has handled this move, and those sent before it.
   * @param {number} seq */
  acknowledge(seq) {
    if (this.kept && this.kept.seq === seq) this.#hold(null);
    for (const one of [...this.inFlight.keys()]) if (one <= seq) this.#end(one);
    this.#next();
  }

  /** The point is gone: drop its moves.
   * @param {string} id */
  forget(id) {
    this.waiting.delete(id);
    if (this.kept && this.kept.id === id) this.#hold(null);
  }

  // Drop waiting moves of a replaced image. Returns the point of the last edit among them, or null.
  abandon() {
    const lost = [...this.waiting.values()].findLast((move) => EDITS.has(move.type));
    this.waiting.clear();
    if (lost && this.kept === lost) this.#hold(null);
    return lost ? lost.id : null;
  }

  /** @param {Move | null} move */
  #hold(move) {
    this.kept = move;
    this.keep(move);
  }

  /** @param {number} seq */
  #end(seq) {
    clearTimeout(this.inFlight.get(seq));
    this.inFlight.delete(seq);
  }

  /** @param {number} seq */
  #giveUp(seq) {
    this.#end(seq);
    this.#next();
  }

  #next() {
    const next = this.waiting.values().next().value;
    if (next && this.inFlight.size === 0) this.#send(next);
  }

  /** @param {Move} move */
  #send(move) {
    this.waiting.delete(move.id);
    this.inFlight.set(move.seq, setTimeout(() => this.#giveUp(move.seq), PATIENCE_MS));
    this.send(move);
  }
}
