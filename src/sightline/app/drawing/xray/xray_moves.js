// Moves of points to the server: drags and nudges one in flight, the newest of each point wins.
//
// Unlimited sends queue behind a slow computation and the curve lags behind the hand; one in flight never does.
// What comes once, at the end of a gesture, waits for nothing: an undo that overtook it would undo something else.

const PATIENCE_MS = 2000; // [ours] an answer that takes longer is lost: far above a computation, short for a person
const EDITS = new Set(["place", "drop", "nudge"]); // what a person did and meant; a drag is on its way still
const ONCE = new Set(["place", "drop"]);

export class Moves {
  // `send(move)` tells the server; `keep(move | null)` holds the newest edit that the server has not acknowledged.
  constructor(send, keep) {
    this.send = send;
    this.keep = keep;
    this.seq = 0;
    this.inFlight = null;
    this.kept = null;
    this.waiting = new Map(); // by point: a newer move replaces an older one
    this.timer = null;
  }

  // A number that the server has not seen.
  number() {
    return ++this.seq;
  }

  // `image`: the address of the one that it was made on; the server takes no move for another. The move's number.
  push(type, id, uv, image) {
    const move = { type, id, uv: [...uv], image, seq: this.number() };
    this.waiting.delete(id); // the newest goes to the end of the line
    this.waiting.set(id, move);
    if (EDITS.has(type)) this.#hold(move);
    if (ONCE.has(type)) this.#send(move);
    else this.#next();
    return move.seq;
  }

  // The person is about to do something else, which must not come before what they did already.
  flush() {
    for (const move of this.waiting.values()) if (EDITS.has(move.type)) this.#send(move);
  }

  acknowledge(seq) {
    if (this.kept && this.kept.seq === seq) this.#hold(null);
    if (this.inFlight && this.inFlight.seq === seq) this.#release();
  }

  // The point is gone, and its moves with it.
  forget(id) {
    this.waiting.delete(id);
    if (this.kept && this.kept.id === id) this.#hold(null);
  }

  // What waits was made on an image that is gone. The point of the last edit among it, null where there is none.
  abandon() {
    const lost = [...this.waiting.values()].findLast((move) => EDITS.has(move.type));
    this.waiting.clear();
    if (lost && this.kept === lost) this.#hold(null);
    return lost ? lost.id : null;
  }

  #hold(move) {
    this.kept = move;
    this.keep(move);
  }

  #release() {
    clearTimeout(this.timer);
    this.inFlight = null;
    this.#next();
  }

  #next() {
    if (this.inFlight || this.waiting.size === 0) return;
    this.#send(this.waiting.values().next().value);
  }

  #send(move) {
    this.waiting.delete(move.id);
    clearTimeout(this.timer);
    this.inFlight = move;
    this.timer = setTimeout(() => this.#release(), PATIENCE_MS);
    this.send(move);
  }
}
