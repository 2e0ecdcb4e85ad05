// Converts plain objects (mm, CFCS) to three.js: a table of named styles, and a maker for each kind.
//
// No meaning depends on colour alone: labels, shapes or dashes carry it too.

import { COLOURS } from "colours";
import { CSS2DObject, THREE } from "nicegui-scene";

/** @typedef {import("./types").Xyz} Xyz */

/** @type {Record<string, import("./types").Style>} */
export const STYLES = {
  pa: { colour: COLOURS.sky },
  left: { colour: COLOURS.sky },
  lateral: { colour: COLOURS.orange, dash: [9, 5] },
  oblique: { colour: COLOURS.green, dash: [3, 3] },
  right: { colour: COLOURS.orange, dash: [9, 5] },
  wire: { colour: COLOURS.yellow },
  drilled: { colour: COLOURS.green },
  ellipsoid: { colour: COLOURS.purple, opacity: 0.5 },
  bone: { colour: COLOURS.bone, opacity: 0.5 },
  tool: { colour: COLOURS.text },
  robot: { colour: COLOURS.steel },
  quiet: { colour: COLOURS.quiet, opacity: 0.55 },
};

const FACETS = 16;
const DOT_PX = 9;
const SEEN_FROM_BEHIND = 0.25; // opacity of an image seen from behind, so that it does not hide the hip
const styleOf = (/** @type {{ style?: string }} */ object) => ({
  opacity: 1,
  dash: null,
  ...(STYLES[object.style ?? ""] ?? STYLES.quiet),
});
const vector = (/** @type {Xyz} */ xyz) => new THREE.Vector3(...xyz);

/** @param {{ style?: string }} object */
function solid(object, more = {}) {
  const { colour, opacity } = styleOf(object);
  return new THREE.MeshLambertMaterial({ color: colour, opacity, transparent: opacity < 1, ...more });
}

/** @param {import("./types").Spheres} object */
function spheres(object) {
  const made = new THREE.InstancedMesh(new THREE.SphereGeometry(1, FACETS, FACETS / 2), solid(object), object.at.length);
  const each = new THREE.Matrix4();
  object.at.forEach((xyz, index) => {
    const radius = Array.isArray(object.radius) ? object.radius[index] : object.radius;
    made.setMatrixAt(index, each.makeScale(radius, radius, radius).setPosition(...xyz));
  });
  return made;
}

function disc() {
  const canvas = Object.assign(document.createElement("canvas"), { width: 32, height: 32 });
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.fillStyle = "white";
  context.arc(16, 16, 15, 0, 2 * Math.PI);
  context.fill();
  return new THREE.CanvasTexture(canvas);
}

/** Dots of constant size on the screen.
 * @param {import("./types").Points} object */
function points(object) {
  const { colour } = styleOf(object);
  const geometry = new THREE.BufferGeometry().setFromPoints(object.at.map(vector));
  const look = { color: colour, size: DOT_PX * window.devicePixelRatio, sizeAttenuation: false, map: disc(), alphaTest: 0.5 };
  return new THREE.Points(geometry, new THREE.PointsMaterial(look));
}

/** @param {Omit<import("./types").Lines, "kind">} object */
function lines(object) {
  const { colour, opacity, dash } = styleOf(object);
  const ends = object.lines.flatMap((line) => line.slice(1).flatMap((xyz, index) => [vector(line[index]), vector(xyz)]));
  const look = { color: colour, opacity, transparent: opacity < 1 };
  const material = dash
    ? new THREE.LineDashedMaterial({ ...look, dashSize: dash[0], gapSize: dash[1] })
    : new THREE.LineBasicMaterial(look);
  const made = new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(ends), material);
  return made.computeLineDistances();
}

/** @param {{ vertices: Xyz[], triangles: Xyz[] }} object */
function surface(object) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(object.vertices.flat(), 3));
  geometry.setIndex(object.triangles.flat());
  return geometry;
}

/** @param {import("./types").Mesh} object */
function mesh(object) {
  const geometry = surface(object);
  geometry.computeVertexNormals();
  const made = new THREE.Mesh(geometry, solid(object));
  made.renderOrder = 1; // after the objects inside it
  return made;
}

/** An image on a surface, facing where its triangles are counter-clockwise.
 * @param {import("./types").Picture} object */
function picture(object) {
  const { width, height, grey } = object.image;
  const bytes = Uint8Array.from(atob(grey), (character) => character.charCodeAt(0));
  const coloured = new Uint8Array(4 * bytes.length);
  bytes.forEach((value, index) => coloured.set([value, value, value, 255], 4 * index));
  const texture = new THREE.DataTexture(coloured, width, height);
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.magFilter = texture.minFilter = THREE.LinearFilter;
  texture.needsUpdate = true;
  const geometry = surface(object);
  geometry.setAttribute("uv", new THREE.Float32BufferAttribute(object.uv.flat(), 2));
  const made = new THREE.Group();
  for (const [side, opacity] of [[THREE.FrontSide, 0.92], [THREE.BackSide, SEEN_FROM_BEHIND]]) {
    const look = { map: texture, side, opacity, transparent: true, depthWrite: false };
    const face = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial(look));
    face.renderOrder = -1; // before all other transparent objects
    made.add(face);
  }
  return made;
}

/** @param {import("./types").Ellipsoid} object */
function ellipsoid(object) {
  const geometry = new THREE.SphereGeometry(1, FACETS, FACETS);
  const [a, b, c] = object.axes.map(vector);
  geometry.applyMatrix4(new THREE.Matrix4().makeBasis(a, b, c).setPosition(...object.at));
  geometry.computeVertexNormals();
  const made = new THREE.Mesh(geometry, solid(object, { side: THREE.DoubleSide, depthWrite: false }));
  return made;
}

/** @param {import("./types").Cylinder} object */
function cylinder(object) {
  const [from, to] = [vector(object.from), vector(object.to)];
  const along = to.clone().sub(from);
  const made = new THREE.Mesh(
    new THREE.CylinderGeometry(object.radius, object.radius, along.length(), FACETS),
    solid(object),
  );
  made.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along.clone().normalize());
  made.position.copy(from).addScaledVector(along, 0.5);
  return made;
}

/** @param {Omit<import("./types").Label, "kind">} object */
function label(object) {
  const words = document.createElement("div");
  words.className = "space-label";
  words.textContent = object.text; // as text: it may come from a file
  words.style.color = styleOf(object).colour;
  const made = new CSS2DObject(words);
  made.position.set(...object.at);
  return made;
}

/** @param {import("./types").Axes} object */
function axes(object) {
  const made = new THREE.Group();
  object.axes.forEach(([x, y, z], index) => {
    const [ox, oy, oz] = object.at;
    made.add(lines({ style: object.style, lines: [[object.at, [ox + x, oy + y, oz + z]]] }));
    made.add(label({ style: object.style, text: object.labels[index], at: [ox + 1.1 * x, oy + 1.1 * y, oz + 1.1 * z] }));
  });
  return made;
}

/** @type {Record<string, (object: any) => THREE.Object3D>} */
const MAKERS = { spheres, points, lines, mesh, picture, ellipsoid, cylinder, label, axes };

/** @param {import("./types").Drawn} object */
export function make(object) {
  const maker = MAKERS[object.kind];
  if (!maker) throw new Error(`no kind of object: ${object.kind}`);
  const made = maker(object);
  made.userData.reach = object.reach ?? "frame";
  return made;
}

/** Frees an object's resources on the graphics card and in the page.
 * @param {THREE.Object3D} made */
export function dispose(made) {
  made.traverse((part) => {
    part.geometry?.dispose();
    part.material?.map?.dispose();
    part.material?.dispose();
    part.element?.remove();
    part.dispose?.();
  });
}
