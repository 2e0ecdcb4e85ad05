// The mapping between image pixels and the view: zoom, place, quarter turns and mirroring.
//
// Image: (u, v) in pixels, (0, 0) the centre of the top-left pixel, u right, v down.
// View:  (x, y) in CSS pixels from the top-left corner of the view, x right, y down.
// The image is mirrored first (u -> -u), then turned clockwise. Only the drawing turns: coordinates never do.

const TURNS = { 0: [1, 0], 90: [0, 1], 180: [-1, 0], 270: [0, -1] }; // cos, sin, exact
const ZOOM_MAX = 64; // [ours] CSS pixels per image pixel: 1/64 px is finer than anybody points
const ZOOM_MIN_OF_FIT = 0.5; // [ours] half of the whole image in the view is as small as helps

export class Display {
  constructor() {
    this.width = 1; // of the image, pixels
    this.height = 1;
    this.viewWidth = 1; // of the view, CSS pixels
    this.viewHeight = 1;
    this.rotation = 0;
    this.mirrored = false;
    this.fitted = true; // stays fitted while the view changes its size
    this.fit();
  }

  // The four numbers of the linear part: view = [a c; b d] image.
  linear() {
    const [cos, sin] = TURNS[this.rotation];
    const m = this.mirrored ? -this.zoom : this.zoom;
    return [cos * m, sin * m, -sin * this.zoom, cos * this.zoom];
  }

  toView([u, v]) {
    const [a, b, c, d] = this.linear();
    const du = u - this.centre[0];
    const dv = v - this.centre[1];
    return [this.viewWidth / 2 + a * du + c * dv, this.viewHeight / 2 + b * du + d * dv];
  }

  toImage([x, y]) {
    const [du, dv] = this.toImageStep([x - this.viewWidth / 2, y - this.viewHeight / 2]);
    return [this.centre[0] + du, this.centre[1] + dv];
  }

  // A step in the view (CSS pixels) as a step in the image (pixels).
  toImageStep([dx, dy]) {
    const [a, b, c, d] = this.linear();
    const determinant = a * d - b * c;
    return [(d * dx - c * dy) / determinant, (a * dy - b * dx) / determinant];
  }

  setImage(width, height) {
    const same = width === this.width && height === this.height;
    this.width = width;
    this.height = height;
    if (!same) this.fit();
  }

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

  // Zoom by a factor; what lies at `at` (CSS pixels) stays there.
  zoomAt(factor, at) {
    const held = this.toImage(at);
    const least = this.fitZoom() * ZOOM_MIN_OF_FIT;
    this.zoom = Math.min(Math.max(this.zoom * factor, least), ZOOM_MAX);
    const moved = this.toImage(at);
    this.moveCentre(held[0] - moved[0], held[1] - moved[1]);
  }

  panBy(dx, dy) {
    const [du, dv] = this.toImageStep([dx, dy]);
    this.moveCentre(-du, -dv);
  }

  // The middle of the view stays on the image: it cannot be lost.
  moveCentre(du, dv) {
    this.fitted = false;
    this.centre = [
      Math.min(Math.max(this.centre[0] + du, 0), this.width - 1),
      Math.min(Math.max(this.centre[1] + dv, 0), this.height - 1),
    ];
  }

  orient(rotation, mirrored) {
    this.rotation = rotation;
    this.mirrored = mirrored;
    if (this.fitted) this.fit();
  }

  turnClockwise() {
    this.orient((this.rotation + 90) % 360, this.mirrored);
  }

  // Left to right as the person sees it: what was turned is turned the other way after it.
  flip() {
    this.orient((360 - this.rotation) % 360, !this.mirrored);
  }

  clamp([u, v]) {
    return [Math.min(Math.max(u, -0.5), this.width - 0.5), Math.min(Math.max(v, -0.5), this.height - 0.5)];
  }

  contains([u, v]) {
    return u >= -0.5 && v >= -0.5 && u <= this.width - 0.5 && v <= this.height - 0.5;
  }
}
