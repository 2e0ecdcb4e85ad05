// Sends moves of points to the server: one drag or nudge in flight, and the newest of each point wins.
//
// Unlimited messages would queue behind a slow computation. A second drag in flight would wait at the server as long as
// the first is computed, while the hand moves on: its figures would be twice as old.
// The last message of a gesture does not wait: an undo that overtook it would undo something else.

/** @typedef {import("./types").Pair} Pair */
/** @typedef {import("./types").Move} Move */

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
