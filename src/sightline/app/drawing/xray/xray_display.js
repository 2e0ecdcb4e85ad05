// The mapping between image pixels and the view: zoom, position, rotation by multiples of 90° and mirroring.
//
// Image: (u, v) in pixels, (0, 0) the centre of the top-left pixel, u right, v down.
// View:  (x, y) in CSS pixels from the top-left corner of the view, x right, y down.
// The image is mirrored first (u -> -u), then rotated clockwise. Only the drawing is rotated, not the coordinates.

/** @typedef {import("./types").Pair} Pair */

/** @type {Record<number, Pair>} */
const ROTATIONS = { 0: [1, 0], 90: [0, 1], 180: [-1, 0], 270: [0, -1] }; // cos, sin, exact
export const ZOOM_MAX = 64; // [ours] CSS pixels per image pixel: 1/64 px is finer than anyone can point
const ZOOM_MIN_OF_FIT = 0.5; // [ours] smallest zoom, as a share of the fitted zoom

export class Display {
  constructor() {
    this.width = 1; // image size, pixels
    this.height = 1;
    /** @type {Pair[]} */
    this.field = [];
    this.viewWidth = 1; // view size, CSS pixels
    this.viewHeight = 1;
    this.rotation = 0;
    this.mirrored = false;
    this.fitted = true; // keep the image fitted when the view's size changes
    this.fit();
  }

  // The linear part: view = [a c; b d] image.
  linear() {
    const [cos, sin] = ROTATIONS[this.rotation];
    const m = this.mirrored ? -this.zoom : this.zoom;
    return [cos * m, sin * m, -sin * this.zoom, cos * this.zoom];
  }

  /** @param {number[]} uv
   * @returns {[number, number]} */
  toView([u, v]) {
    const [a, b, c, d] = this.linear();
    const du = u - this.centre[0];
    const dv = v - this.centre[1];
    return [this.viewWidth / 2 + a * du + c * dv, this.viewHeight / 2 + b * du + d * dv];
  }

  /** @param {number[]} at
   * @returns {[number, number]} */
  toImage([x, y]) {
    const [du, dv] = this.toImageStep([x - this.viewWidth / 2, y - this.viewHeight / 2]);
    return [this.centre[0] + du, this.centre[1] + dv];
  }

  /** Converts a displacement in the view (CSS pixels) to image pixels.
   * @param {number[]} step
   * @returns {[number, number]} */
  toImageStep([dx, dy]) {
    const [a, b, c, d] = this.linear();
    const determinant = a * d - b * c;
    return [(d * dx - c * dy) / determinant, (a * dy - b * dx) / determinant];
  }

  /** `field`: corners of the convex part that X-rays reach, clockwise as the image is stored; null: all of it.
   * @param {{ width: number, height: number, field: Pair[] | null }} image */
  setImage({ width, height, field }) {
    this.field = field || [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]];
    const same = width === this.width && height === this.height;
    this.width = width;
    this.height = height;
    if (!same) this.fit();
  }

  /** @param {number} width
   * @param {number} height */
  setView(width, height) {
    this.viewWidth = Math.max(width, 1);
    this.viewHeight = Math.max(height, 1);
    if (this.fitted) this.fit();
  }

  fitZoom() {
    const upright = this.rotation % 180 === 0;
    const across = upright ? this.width : this.height;
    const down = upright ? this.height : this.width;
    return Math.min(this.viewWidth / across, this.viewHeight / down);
  }

  fit() {
    this.fitted = true;
    this.centre = [(this.width - 1) / 2, (this.height - 1) / 2];
    this.zoom = this.fitZoom();
  }

  /** Zoom by a factor about the position `at` (CSS pixels).
   * @param {number} factor
   * @param {number[]} at */
  zoomAt(factor, at) {
    const held = this.toImage(at);
    const least = this.fitZoom() * ZOOM_MIN_OF_FIT;
    this.zoom = Math.min(Math.max(this.zoom * factor, least), ZOOM_MAX);
    const moved = this.toImage(at);
    this.moveCentre(held[0] - moved[0], held[1] - moved[1]);
  }

  /** Takes the zoom of another display, each measured by its own fitted one, and holds the position `at` (CSS pixels).
   * Returns whether that changed anything.
   * @param {Display} other
   * @param {number[]} at */
  follow(other, at) {
    const factor = (other.zoom / other.fitZoom()) * (this.fitZoom() / this.zoom);
    if (Math.abs(factor - 1) < 1e-9) return false;
    if (other.fitted) this.fit();
    else this.zoomAt(factor, at);
    return true;
  }

  /** Moves the image so that a pixel is in the view.
   * @param {number[]} uv */
  reveal(uv) {
    const [x, y] = this.toView(uv);
    const [dx, dy] = [Math.min(Math.max(x, 0), this.viewWidth) - x, Math.min(Math.max(y, 0), this.viewHeight) - y];
    if (dx || dy) this.panBy(dx, dy);
  }

  /** The middle of the view, CSS pixels.
   * @returns {[number, number]} */
  get middle() {
    return [this.viewWidth / 2, this.viewHeight / 2];
  }

  /** @param {number} dx
   * @param {number} dy */
  panBy(dx, dy) {
    const [du, dv] = this.toImageStep([dx, dy]);
    this.moveCentre(-du, -dv);
  }

  /** Keeps the centre of the view on the image, so that the image stays visible.
   * @param {number} du
   * @param {number} dv */
  moveCentre(du, dv) {
    this.fitted = false;
    this.centre = [
      Math.min(Math.max(this.centre[0] + du, 0), this.width - 1),
      Math.min(Math.max(this.centre[1] + dv, 0), this.height - 1),
    ];
  }

  /** @param {number} rotation
   * @param {boolean} mirrored */
  orient(rotation, mirrored) {
    this.rotation = rotation;
    this.mirrored = mirrored;
    if (this.fitted) this.fit();
  }

  turnClockwise() {
    this.orient((this.rotation + 90) % 360, this.mirrored);
  }

  // Mirror left to right as seen on screen; an existing rotation therefore changes its sign.
  flip() {
    this.orient((360 - this.rotation) % 360, !this.mirrored);
  }

  /** The position itself, or the nearest one in the field.
   * @param {Pair} uv
   * @returns {Pair} */
  clamp(uv) {
    if (this.contains(uv)) return uv;
    let best = uv;
    let least = Infinity;
    this.field.forEach(([u, v], index) => {
      const [du, dv] = this.#side(index);
      const along = ((uv[0] - u) * du + (uv[1] - v) * dv) / (du * du + dv * dv);
      const share = Math.min(Math.max(along, 0), 1);
      /** @type {Pair} */
      const at = [u + share * du, v + share * dv];
      const away = Math.hypot(at[0] - uv[0], at[1] - uv[1]);
      if (away < least) [best, least] = [at, away];
    });
    return best;
  }

  /** Whether X-rays reach a position.
   * @param {Pair} uv */
  contains(uv) {
    return this.field.every(([u, v], index) => {
      const [du, dv] = this.#side(index);
      return du * (uv[1] - v) - dv * (uv[0] - u) >= 0;
    });
  }

  /** @param {number} index
   * @returns {Pair} */
  #side(index) {
    const [u, v] = this.field[index];
    const [nextU, nextV] = this.field[(index + 1) % this.field.length];
    return [nextU - u, nextV - v];
  }
}
