// The messages of the X-ray view, and what it keeps of them. For the type checker alone.

/** Pixels (u, v) of an image, or CSS pixels (x, y) of the view. */
export type Pair = [number, number];

/** A grey-level window: black at centre - width / 2, white at centre + width / 2. */
export interface Window {
  centre: number;
  width: number;
}

/** A shape of a layer (image pixels). `of`: the point that a curve belongs to; `from`: depth of a band's first sample;
 * `legend`: a line at the foot of the view while the shape is shown. */
export interface Shape {
  shape: string;
  style: string;
  points: Pair[];
  of?: string;
  title?: string;
  label?: string | string[];
  legend?: string;
  radius?: number | number[];
  value?: number;
  halfWidth?: number | number[];
  from?: number;
}

/** A point as the server sends it. */
export interface PointSent {
  id: string;
  style: string;
  label?: string;
  uv?: Pair | null;
  movable?: boolean;
  snapped?: boolean;
  slides?: boolean;
}

export interface Point {
  id: string;
  style: string;
  label: string;
  uv: Pair | null;
  movable: boolean;
  snapped: boolean;
  slides: boolean;
}

export type Placed = Point & { uv: Pair };

export interface Picture {
  url: string;
  width: number;
  height: number;
  window: Window;
  field: Pair[] | null;
  presets?: Record<string, Window>;
}

export type Image = Picture & { pixels: Uint16Array };

export interface Shown {
  rotation: number;
  mirrored: boolean;
  inverted: boolean;
  window: Window;
}

export interface Matching {
  from: string;
  title: string;
  names?: Record<string, string>;
  sights: string[];
}

/** The complete content of a view. `layers`: null for one that is as in the message before. */
export interface Word {
  version: number;
  label: string;
  picture: Picture | null;
  display: Shown | null;
  layers: Record<string, Shape[] | null>;
  points: PointSent[];
  placing: string | null;
  notice: string | null;
  revision: string;
  matching: Matching | null;
  head: number | null;
  identity: string;
}

/** A message: what is another content than in the message before, and all layers. */
export type News = Partial<Word> & Pick<Word, "version" | "layers">;

/** A person's move of a point. */
export interface Move {
  type: string;
  id: string;
  uv: Pair;
  image: string | null;
  seq: number;
}

export type Texts = Record<string, string>;
