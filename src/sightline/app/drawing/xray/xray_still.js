// Which marks stand still while a point moves: they are painted once, over the image, on a canvas off the page. Strokes
// are most of a frame's time.

/** @typedef {object | string} Key of a mark: another one once it must be painted otherwise */

/** @type {Set<Key>} */
const NONE = new Set();

export class Still {
  constructor() {
    /** @type {Set<Key>} */
    this.before = new Set(); // of the previous frame
    /** @type {Set<Key> | null} */
    this.painted = null; // on the canvas; null: it holds nothing of use
  }

  /** The marks, of all `keys` in a frame, that lie on the canvas. A mark counts as still if the previous frame had it.
   * `moving`: a point moves; else none is kept, so that all are painted in their order. `paint(still)` clears the
   * canvas and paints these marks on it.
   * @param {Key[]} keys
   * @param {boolean} moving
   * @param {(still: Set<Key>) => void} paint */
  of(keys, moving, paint) {
    const now = new Set(keys);
    if (!moving) this.painted = null;
    else if (!this.painted || [...this.painted].some((key) => !now.has(key))) {
      this.painted = new Set(keys.filter((key) => this.before.has(key)));
      paint(this.painted);
    }
    this.before = now;
    return this.painted ?? NONE;
  }

  /** The image below has changed, or how marks are painted. */
  forget() {
    this.painted = null;
  }
}
