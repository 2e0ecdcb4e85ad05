// The plain objects of the 3-D scene as the server sends them (document.py); mm, CFCS. For the type checker alone.

export type Xyz = [number, number, number];
export type Uv = [number, number];
export type Reach = "hip" | "frame" | "room";

interface Made {
  style?: string;
  reach?: Reach;
}

export interface Spheres extends Made {
  kind: "spheres";
  at: Xyz[];
  radius: number | number[];
}

export interface Points extends Made {
  kind: "points";
  at: Xyz[];
}

export interface Lines extends Made {
  kind: "lines";
  lines: Xyz[][];
}

export interface Mesh extends Made {
  kind: "mesh";
  vertices: Xyz[];
  triangles: Xyz[];
}

/** `uv` of the vertices from the top left, 0 to 1; `grey`: base64 bytes, row by row. */
export interface Picture extends Made {
  kind: "picture";
  vertices: Xyz[];
  triangles: Xyz[];
  uv: Uv[];
  image: { width: number; height: number; grey: string };
}

/** `axes`: three half axes. */
export interface Ellipsoid extends Made {
  kind: "ellipsoid";
  at: Xyz;
  axes: [Xyz, Xyz, Xyz];
}

export interface Cylinder extends Made {
  kind: "cylinder";
  from: Xyz;
  to: Xyz;
  radius: number;
}

export interface Label extends Made {
  kind: "label";
  at: Xyz;
  text: string;
}

export interface Axes extends Made {
  kind: "axes";
  at: Xyz;
  axes: Xyz[];
  labels: string[];
}

export type Drawn = Spheres | Points | Lines | Mesh | Picture | Ellipsoid | Cylinder | Label | Axes;

/** Text below the scene; it is not drawn. */
export interface Note {
  kind: "note";
  text: string;
}

export type SpaceObject = Drawn | Note;

/** dash: mm on, mm off. */
export interface Style {
  colour: string;
  opacity?: number;
  dash?: [number, number];
}

export interface SpaceOptions {
  label: string;
  /** Text in the legend by the name of a group. */
  groups: Record<string, string>;
  texts: Record<string, string>;
}
