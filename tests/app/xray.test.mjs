// Units of the X-ray view's scripts that need no page: `node --test tests/app/xray.test.mjs`.

import assert from "node:assert/strict";
import { register } from "node:module";
import { test } from "node:test";

globalThis.window = new EventTarget();
globalThis.document = { querySelectorAll: () => [] };
globalThis.document.documentElement = { style: { setProperty() {} } }; // colours.js names the page's colours
register("data:text/javascript," + encodeURIComponent(`
  export const resolve = (name, context, next) =>
    next(name === "colours" ? "${new URL("../../src/sightline/app/drawing/colours.js", import.meta.url)}" : name, context);`));
const root = new URL("../../src/sightline/app/drawing/xray/", import.meta.url);
const { Crosshair } = await import(new URL("xray_reading.js", root));
const { Display } = await import(new URL("xray_display.js", root));
const { Edits } = await import(new URL("xray_edits.js", root));
const { Gestures } = await import(new URL("xray_gestures.js", root));
const { arrange, Labels } = await import(new URL("xray_labels.js", root));
const { hasDirection, reaches, thinned } = await import(new URL("xray_paint.js", root));
const { Ruler } = await import(new URL("xray_reading.js", root));
const { Matching } = await import(new URL("xray_matching.js", root));
const { Moves } = await import(new URL("xray_edits.js", root));
const sight = await import(new URL("xray_sight.js", root));
const { Still } = await import(new URL("xray_canvas.js", root));

const near = (a, b, by) => a.forEach((value, k) => assert.ok(Math.abs(value - b[k]) < by, `${a} is not ${b}`));

function grid(start, step, count, value) {
  const values = [];
  for (let row = 0; row < count; row++) {
    for (let column = 0; column < count; column++) values.push(value([start[0] + column * step[0], start[1] + row * step[1]]));
  }
  return { start, step, count, values };
}

// A pinhole camera at `focal` before a plane through `origin`: 5 px/mm, (512, 512) at the plane's origin.
function camera(focal, origin, axes) {
  const toPlane = grid([-100, -100], [40, 40], 31, ([u, v]) => [(u - 512) / 5, (v - 512) / 5]);
  const toImage = grid([-130, -130], [10, 10], 27, ([x, y]) => [512 + 5 * x, 512 + 5 * y]);
  const sides = [[1, 0, -1000], [-1, 0, 0], [0, 1, -1000], [0, -1, 0]]; // 0 to 1000 px
  return new sight.Sight({ focal, origin, axes, toPlane, toImage, sides, reach: 20 });
}

const PA = camera([0, 0, -600], [0, 0, 400], [[1, 0, 0], [0, 1, 0]]);
const LATERAL = camera([-600, 0, 0], [400, 0, 0], [[0, 1, 0], [0, 0, 1]]);

test("a grid is exact for a quadratic, and has no value beside it or at a missing node", () => {
  const value = ([x, y]) => [1 + 2 * x - y + 0.3 * x * y + 0.2 * y * y, x * x];
  const made = grid([-1, -2], [0.5, 0.25], 12, value);
  near(sight.interpolated(made, [1.37, -0.71]), value([1.37, -0.71]), 1e-12);
  assert.equal(sight.interpolated(made, [-0.9, -1]), null);
  assert.equal(sight.interpolated(made, [NaN, -1]), null);
  made.values[12 * 5 + 4] = null;
  assert.equal(sight.interpolated(made, [1.1, -0.8]), null);
});

test("a curve is the line of sight, as the other view shows it", () => {
  const curve = sight.matchingCurve(PA, [612, 487], LATERAL);
  assert.ok(curve.uv.length > 20);
  const [x, y] = [20, -5]; // of the pixel on the plane, at z = 400
  const length = Math.hypot(x, y, 1000);
  curve.depth.forEach((depth, k) => {
    const share = depth / length;
    const point = [x * (1 - share), y * (1 - share), 400 - 1000 * share];
    const times = 1000 / (point[0] + 600);
    near(curve.uv[k], [512 + 5 * times * point[1], 512 + 5 * times * point[2]], 1e-6);
    assert.equal(depth % 2, 0);
  });
  assert.equal(sight.matchingCurve(PA, [1500, 487], LATERAL), null);
});

test("a place on a curve, by pixel and by depth", () => {
  const curve = { depth: [-4, -2, 0, 2, 4], uv: [[0, 0], [10, 0], [20, 0], [20, 10], [20, 20]] };
  assert.equal(sight.nearest(curve, [13, 4]), 1.3);
  near([sight.depthAt(curve, [13, 4])], [-1.4], 1e-12);
  near(sight.pixelAtDepth(curve, -1.4), [13, 0], 1e-12);
  assert.deepEqual(sight.pixelAtDepth(curve, 99), [20, 15]); // not quite at its end
  assert.deepEqual(sight.pixelAt(curve, sight.nearest(curve, [-50, 3])), [5, 0]);
  const shapes = sight.curveShapes({ depth: [48, 50, 52], uv: [[0, 0], [1, 0], [2, 0]] }, "end", "title", (depth) => depth / 2);
  assert.deepEqual(shapes[0].halfWidth, [24, 25, 26]);
  assert.deepEqual([shapes[2].points, shapes[2].label], [[[1, 0]], ["50"]]);
  assert.ok(shapes.every(({ of }) => of === "end"));
});

test("a curve that moves replaces the server's, with the widths of its newest band", async () => {
  const documents = { "/a": PA.document, "/b": LATERAL.document };
  globalThis.fetch = async (address) => ({ ok: true, json: async () => documents[address] });
  const matching = new Matching();
  const band = { shape: "band", of: "end", points: [], halfWidth: [3, 4], from: 400 };
  const given = [band, { shape: "line", of: "end", points: [] }, { shape: "line", of: "entry", points: [] }];
  matching.show({ from: "pa", title: "of {name}", sights: ["/a", "/b"] }, given, assert.fail);
  assert.deepEqual(matching.over(given, new Map([["end", [612, 487]]])), given.filter(({ of }) => of !== "end")); // no maps yet
  await new Promise((done) => setTimeout(done));
  assert.equal(matching.over(given, new Map()), given);
  const shown = matching.over(given, new Map([["end", [612, 487]]]));
  assert.deepEqual(shown.filter(({ of }) => of === "entry"), [given[2]]);
  const [wide, line] = shown.filter(({ of }) => of === "end");
  assert.ok(line.points.length > 20 && line.title === "of end");
  assert.ok(wide.halfWidth.every((half) => half === 3 || half === 4));
  const place = sight.pixelAt({ depth: [], uv: line.points }, 30.25);
  near(matching.onCurve("end", [612, 487], place), place, 1e-9);
  const after = matching.slid("end", place, [612, 487], [650, 470]);
  const [was, is] = [[612, 487], [650, 470]].map((uv) => sight.matchingCurve(PA, uv, LATERAL));
  near([sight.depthAt(is, after)], [sight.depthAt(was, place)], 1e-6);
});

const width = (text) => 8 * text.length;
const boxOf = ({ text, at: [x, y] }) => ({ left: x - width(text) / 2, right: x + width(text) / 2, top: y - 9, bottom: y + 9 });
const meet = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;

function labelled(turn, named) {
  const [cos, sin] = [Math.cos(turn), Math.sin(turn)];
  const curve = (offset) => Array.from({ length: 60 }, (_, k) => [250 + cos * (k - 30) * 8 - sin * offset, 250 + sin * (k - 30) * 8 + cos * offset]);
  const [one, two] = [curve(-24), curve(24)]; // so near that not every number has room
  const ticks = (of, line) => [{ shape: "ticks", of, label: line.filter((_, k) => k % 5 === 0).map((_, k) => String(10 * k)) }, line.filter((_, k) => k % 5 === 0)];
  const shapes = [[{ shape: "line", of: "entry" }, one], ticks("entry", one), [{ shape: "line", of: "end" }, two], ticks("end", two)];
  const points = [[{ id: "entry", label: "Entry point" }, one[31]], [{ id: "end", label: "End point" }, two[30]]];
  const labels = new Labels(width, [500, 500]);
  arrange(labels, shapes, points, new Set(named), (id) => ({ name: `curve of ${id}`, colour: id }));
  return { texts: labels.texts, one, two, points };
}

test("no text is over another, a tick, a curve or a point; curves have their points' colours", () => {
  for (const turn of [0, 0.4, Math.PI / 4, 1.2, Math.PI / 2]) {
    const { texts, one, two, points } = labelled(turn, []);
    const boxes = texts.map(boxOf);
    boxes.forEach((box, k) => boxes.slice(k + 1).forEach((other) => assert.ok(!meet(box, other), `${turn}: ${texts[k].text}`)));
    for (const [x, y] of [...one, ...two, ...points.map(([, at]) => at)]) {
      const near = { left: x - 2, right: x + 2, top: y - 2, bottom: y + 2 };
      boxes.forEach((box, k) => assert.ok(!meet(box, near), `${turn}: ${texts[k].text} at ${x}, ${y}`));
    }
    const named = texts.filter(({ text }) => text.startsWith("curve")).map(({ text, colour }) => [text, colour]);
    assert.deepEqual(named, [["curve of entry", "entry"], ["curve of end", "end"]]);
    assert.ok(texts.length > 4, `${turn}: ${texts.length}`);
  }
});

test("a point is named where it is hovered over or selected, on any side, and always", () => {
  assert.ok(!labelled(0, []).texts.some(({ text }) => text === "End point"));
  assert.equal(labelled(0.4, ["end", null]).texts.filter(({ text }) => text === "End point").length, 1);
  const labels = new Labels(width, [100, 30]); // without room
  arrange(labels, [], [[{ id: "end", label: "End point" }, [90, 15]]], new Set(["end"]), () => null);
  assert.equal(labels.texts.length, 1);
});

test("what lies outside the view has no name in it: that would stand beside another point", () => {
  const labels = new Labels(width, [500, 500]);
  const points = [[{ id: "end", label: "End point" }, [530, 200]], [{ id: "entry", label: "Entry point" }, [480, 210]]];
  const arrow = [{ shape: "arrow", label: "tip 0.2 mm off" }, [[490, 300], [520, 300]]];
  arrange(labels, [arrow], points, new Set(["end", "entry"]), () => null);
  assert.deepEqual(labels.texts.map(({ text }) => text), ["Entry point"]);
});

test("one move is in flight, and the newest of those that wait is next", () => {
  const sent = [];
  const moves = new Moves((move) => sent.push(move), () => {});
  for (let k = 1; k <= 5; k++) moves.push("drag", "end", [k, 0], "/image");
  assert.deepEqual(sent.map(({ uv }) => uv[0]), [1]);
  moves.acknowledge(sent[0].seq);
  assert.deepEqual(sent.map(({ uv }) => uv[0]), [1, 5]);
  for (const { seq } of [...sent]) moves.acknowledge(seq);
  moves.push("nudge", "end", [6, 0], "/image");
  moves.push("nudge", "end", [7, 0], "/image");
  assert.deepEqual(sent.map(({ uv }) => uv[0]), [1, 5, 6]); // each nudge is a decision: one at a time
  moves.push("drop", "end", [8, 0], "/image");
  assert.deepEqual(sent.map(({ uv }) => uv[0]), [1, 5, 6, 8]); // the last of a gesture waits for nothing
  for (const { seq } of [...sent]) moves.acknowledge(seq);
});

function held() {
  const display = new Display();
  display.setView(500, 500);
  display.setImage({ width: 1000, height: 1000, field: null });
  const point = { id: "end", uv: [400, 600], movable: true };
  const said = [];
  const core = {
    stage: Object.assign(new EventTarget(), {
      dataset: {},
      focus() {},
      setPointerCapture() {},
      getBoundingClientRect: () => ({ left: 10, top: 20 }),
    }),
    chrome: { showTip() {}, showLine() {}, say: (text) => said.push(["say", text]) },
    display,
    lens: null,
    state: { points: new Map([["end", point]]), dragging: null, placing: null, selected: null, tool: "pan", image: {}, maximised: false },
    reading: {
      titleAt: () => "",
      pointAt: ([x, y], reach) => (Math.hypot(x - display.toView(point.uv)[0], y - display.toView(point.uv)[1]) <= reach ? point : null),
    },
    point: (id) => core.state.points.get(id) || null,
    edits: {
      moves: { flush() {} },
      aimed: (uv) => uv,
      move(type, id, uv) {
        point.uv = uv;
        said.push([type, ...uv]);
      },
      placeAt: (uv) => said.push(["place", ...uv]),
    },
    settings: { setTool: (tool) => (core.state.tool = tool), movedView() {}, maximise() {} },
    focusPoint() {},
    shownUrl: "/image",
    emit: (event) => said.push([event.type, event.points]),
    select() {},
    hover() {},
    release: () => said.push(["release"]),
    canvas: { unit: 1, invalidate() {} },
  };
  core.crosshair = new Crosshair(core);
  core.ruler = new Ruler(core);
  core.reading.describe = ({ uv }) => uv.map((value) => value.toFixed(1)).join(" ");
  new Gestures(core);
  const key = (name, more = {}) => core.stage.dispatchEvent(Object.assign(new Event("keydown", { cancelable: true }), { key: name, ...more }));
  const send = (type, x, y, more = {}) => {
    const event = Object.assign(new Event(type, { cancelable: true }), { clientX: x + 10, clientY: y + 20, pointerId: 1, ...more });
    core.stage.dispatchEvent(Object.assign(event, { pointerType: more.pointerType || "mouse", button: 0 }));
  };
  return { core, point, said, send, key };
}

test("a drag keeps the grip, and ends where it is dropped", () => {
  const { said, send } = held();
  send("pointerdown", 204, 297); // the point is at (200.25, 300.25)
  send("pointermove", 214, 307);
  send("pointerup", 214, 307);
  near(said[0].slice(1), [420, 620], 1e-9);
  assert.deepEqual(said.map(([type]) => type), ["drag", "drop"]);
});

test("a finger moves nothing until it has moved", () => {
  const { said, send } = held();
  send("pointerdown", 204, 297, { pointerType: "touch" });
  send("pointermove", 207, 297, { pointerType: "touch" });
  send("pointerup", 207, 297, { pointerType: "touch" });
  assert.deepEqual(said, [["release"]]);
});

test("Escape takes a drag back to its start", () => {
  const { said, send } = held();
  send("pointerdown", 200, 300);
  send("pointermove", 260, 300);
  window.dispatchEvent(Object.assign(new Event("keydown", { cancelable: true }), { key: "Escape" }));
  assert.deepEqual(said.at(-1), ["drop", 400, 600]);
});

test("a pinch zooms about the middle of both fingers", () => {
  const { core, said, send } = held();
  const before = core.display.toImage([250, 100]);
  send("pointerdown", 200, 100, { pointerType: "touch" });
  send("pointerdown", 300, 100, { pointerType: "touch", pointerId: 2 });
  send("pointermove", 150, 100, { pointerType: "touch" });
  send("pointermove", 350, 100, { pointerType: "touch", pointerId: 2 });
  near([core.display.zoom], [1.0], 1e-9); // from 0.5
  near(core.display.toImage([250, 100]), before, 1e-9);
  assert.deepEqual(said, []);
});

test("the keyboard's cross-hair steps on the screen, finely with shift, and Enter places it", () => {
  const { core, said, key } = held();
  core.display.orient(90, false); // down on the screen is to the right in the image
  core.state.placing = "end";
  key("ArrowDown");
  near(core.crosshair.uv, [499.5, 499.5], 1e-9); // it appears in the middle
  key("ArrowDown");
  key("ArrowDown", { shiftKey: true });
  near(core.crosshair.uv, [499.5 + 10 / core.display.zoom + 1, 499.5], 1e-9);
  near(core.lens.uv, core.crosshair.uv, 1e-9);
  near(core.lens.at, core.display.toView(core.crosshair.uv), 1e-9);
  assert.deepEqual(said.at(-1), ["say", "520.5 499.5"]);
  key("Enter");
  assert.deepEqual(said.at(-1)[0], "place");
  near(said.at(-1).slice(1), core.crosshair.uv, 1e-9);
});

test("the cross-hair slides on a curve, stays in the field and in view, and gives way to the pointer", () => {
  const { core, key, send } = held();
  core.state.placing = "end";
  core.edits.aimed = ([u]) => [u, 200];
  key("ArrowRight");
  key("ArrowRight");
  near(core.crosshair.uv, [519.5, 200], 1e-9);
  core.display.zoomAt(4, [0, 0]);
  for (let k = 0; k < 300; k++) key("ArrowRight");
  near(core.crosshair.uv, [999.5, 200], 1e-9);
  const [x, y] = core.display.toView(core.crosshair.uv);
  assert.ok(x >= 0 && x <= 500 && y >= 0 && y <= 500, `${x}, ${y}`);
  send("pointermove", 100, 100);
  assert.equal(core.crosshair.uv, null);
});

test("without a point to place the arrow keys pan", () => {
  const { core, key } = held();
  const before = core.display.toView([499.5, 499.5]);
  key("ArrowRight");
  near(core.display.toView([499.5, 499.5]), [before[0] - 40, before[1]], 1e-9);
  assert.equal(core.crosshair.uv, null);
});

test("the ruler asks for a length after two clicks, for an angle after three, and then begins anew", () => {
  const { core, said, send } = held();
  core.state.tool = "measure";
  core.state.placing = "end"; // nothing is placed meanwhile
  const click = (x, y) => [send("pointerdown", x, y), send("pointerup", x, y)];
  click(100, 100);
  assert.deepEqual(said, []);
  click(200, 300); // on the point, which stays
  click(50, 60);
  const asked = said.map(([type, points]) => [type, points.length]);
  assert.deepEqual(asked, [["measure", 2], ["measure", 3]]);
  near(said[1][1][2], core.display.toImage([50, 60]), 1e-9);
  core.ruler.show("31.4 mm", "");
  assert.equal(core.ruler.shapes[0].label, "31.4 mm");
  click(10, 10);
  assert.equal(core.ruler.points.length, 1);
  window.dispatchEvent(Object.assign(new Event("keydown", { cancelable: true }), { key: "Escape" }));
  assert.equal(core.state.tool, "pan");
});

test("the magnifier is shown where a click is taken, and nowhere else", () => {
  const { core, send } = held(); // the image is 500 by 500 px of the view
  core.state.placing = "end";
  send("pointermove", 480, 20);
  near(core.lens.uv, core.display.toImage([480, 20]), 1e-9);
  core.display.setView(700, 500); // black on both sides
  send("pointermove", 40, 20);
  assert.equal(core.lens, null);
  core.edits.aimed = ([, v]) => [500, v]; // a point that slides on its curve is placed from there too
  send("pointermove", 40, 20);
  near(core.lens.uv, [500, core.display.toImage([40, 20])[1]], 1e-9);
  core.state.placing = null;
  core.state.tool = "measure"; // a click of the ruler goes to the border
  send("pointermove", 40, 20);
  near(core.lens.uv, core.display.clamp(core.display.toImage([40, 20])), 1e-9);
  send("pointerdown", 40, 20);
  send("pointerup", 40, 20);
  assert.deepEqual(core.ruler.points[0], core.lens.uv);
});

// A view with one point, as `Edits` needs it. Its curve is the row v = 200.
function edited(sent) {
  const nothing = () => {};
  const display = new Display();
  display.setImage({ width: 1000, height: 1000, field: null });
  const said = [];
  const core = {
    word: { points: [sent], placing: null },
    state: { points: new Map(), placing: null, dragging: null, image: {} },
    following: { moving: new Map(), followers: [], slid: (_, [u]) => [u, 200] },
    chrome: { showLine: nothing, say: nothing },
    reading: { describe: nothing },
    buttons: { show: nothing },
    canvas: { invalidate: nothing },
    crosshair: { end: nothing },
    gestures: { showCursor: nothing },
    texts: { placing: "{name}", off_field: "", held_in_field: "", edit_lost: "{name}" },
    emit: (event) => said.push(event),
    point: (id) => core.state.points.get(id) ?? null,
    select: nothing,
    release: nothing,
    report: assert.fail,
    get placed() {
      return [...core.state.points.values()].filter(({ uv }) => uv);
    },
    display,
    shownUrl: "/image",
    url: "/image",
  };
  core.edits = new Edits(core, nothing);
  core.edits.merge();
  return { core, edits: core.edits, said };
}

const uvOf = ({ state }) => state.points.get("end").uv;

test("a moved point stays until its move is acknowledged, and is then where the server has it", () => {
  const { core, edits, said } = edited({ id: "end", style: "aid", uv: [10, 20] });
  edits.move("drop", "end", [30, 40]);
  core.word = { points: [{ id: "end", style: "aid", uv: [11, 21] }], placing: null };
  edits.merge();
  assert.deepEqual([uvOf(core), [...edits.moved.keys()]], [[30, 40], ["end"]]);
  edits.acknowledge(said[0].seq + 1); // of another action
  edits.merge();
  assert.deepEqual(uvOf(core), [30, 40]);
  edits.acknowledge(said[0].seq);
  edits.merge();
  assert.deepEqual([uvOf(core), edits.moved.size], [[11, 21], 0]);
});

test("a selected point that becomes fixed is no longer selected: its name would stay for good", () => {
  const movable = { id: "end", style: "aid", uv: [10, 20], movable: true };
  const fixed = { ...movable, movable: false };
  const { core, edits } = edited(movable);
  core.select = (id) => (core.state.selected = id);
  core.state.selected = "end";
  edits.merge();
  assert.equal(core.state.selected, "end");
  core.word = { points: [fixed], placing: null };
  edits.merge();
  assert.equal(core.state.selected, null);
  core.select("end"); // by a person who asks for its name
  edits.merge();
  assert.equal(core.state.selected, "end");
});

test("a snapped point moves on its curve, and one that is placed goes there only if it slides", () => {
  const snapped = edited({ id: "end", style: "aid", uv: [10, 200], snapped: true });
  snapped.edits.move("drag", "end", [30, 40]);
  assert.deepEqual(uvOf(snapped.core), [30, 200]);
  snapped.edits.move("place", "end", [30, 40]);
  assert.deepEqual(uvOf(snapped.core), [30, 40]);
  const slides = edited({ id: "end", style: "aid", slides: true });
  slides.core.word.placing = "end";
  slides.edits.showPlacing();
  slides.edits.placeAt([50, 60]);
  assert.deepEqual([uvOf(slides.core), slides.core.state.placing], [[50, 200], null]);
});

test("nothing is placed off the field or over an image that is being replaced", () => {
  const { core, edits, said } = edited({ id: "end", style: "aid" });
  core.word.placing = "end";
  edits.showPlacing();
  edits.placeAt([-5, 60]);
  core.url = "/next";
  edits.placeAt([50, 60]);
  assert.deepEqual([uvOf(core), core.state.placing, said], [null, "end", []]);
});

test("a thinned polyline keeps its course, its corners and its ends", () => {
  const arc = Array.from({ length: 200 }, (_, k) => [300 * Math.cos(k / 80), 300 * Math.sin(k / 80)]);
  const few = thinned(arc);
  assert.ok(few.length < 80 && few.length > 20);
  for (const [x, y] of arc) {
    const away = few.slice(1).map(([x1, y1], k) => {
      const [x0, y0] = few[k];
      const t = ((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / ((x1 - x0) ** 2 + (y1 - y0) ** 2);
      return Math.hypot(x - x0 - Math.min(Math.max(t, 0), 1) * (x1 - x0), y - y0 - Math.min(Math.max(t, 0), 1) * (y1 - y0));
    });
    assert.ok(Math.min(...away) <= 0.05);
  }
  assert.deepEqual(thinned([[0, 0], [1, 0.01], [2, -0.01], [3, 0]]), [[0, 0], [3, 0]]);
  assert.deepEqual(thinned([[0, 0], [5, 0.2], [10, 0]]), [[0, 0], [5, 0.2], [10, 0]]);
  assert.deepEqual(thinned([[0, 0], [9, 0], [9, 9], [0, 0]]), [[0, 0], [9, 0], [9, 9], [0, 0]]); // closed
  assert.deepEqual(thinned([[1, 2]]), [[1, 2]]);
  assert.deepEqual(thinned([]), []);
});

test("no text is written over the image's name; fails where the corner is not kept free", () => {
  const labels = new Labels(() => 60, [400, 300]);
  labels.keepCorner([120, 40]);
  assert.equal(labels.write("a point", [[60, 30]]), false);
  assert.ok(labels.write("a point", [[60, 30], [60, 60]]));
  assert.deepEqual(labels.texts[0].at, [60, 60]);
});

test("marks are still that the frame before had; what moves is painted in each frame", () => {
  const [still, painted] = [new Still(), []];
  const frame = (keys, moving) => [...still.of(keys, moving, (kept) => painted.push([...kept]))];
  const [wire, aid] = [{}, {}];
  assert.deepEqual(frame([wire, aid, "at 1"], false), []); // at rest all are painted in their order
  assert.deepEqual(frame([wire, aid, "at 2"], true), [wire, aid]);
  assert.deepEqual(frame([wire, aid, "at 3"], true), [wire, aid]);
  assert.equal(painted.length, 1); // the canvas is painted once; fails where each frame paints it
  const next = {};
  assert.deepEqual(frame([next, aid, "at 4"], true), [aid]); // a wire that was replaced is not left behind
  assert.deepEqual(frame([next, aid, "at 5"], true), [aid]);
  still.forget(); // another image below
  assert.deepEqual(frame([next, aid, "at 6"], true), [next, aid]);
  assert.deepEqual(painted, [[wire, aid], [aid], [next, aid]]);
  assert.deepEqual(frame([next, aid, "at 6"], false), []);
  assert.deepEqual(frame([next, aid, "at 7"], true), [next, aid]);
});

test("a shape reaches the magnifier by its line, its band or its circle; fails where one is left out", () => {
  const box = { middle: [0, 0], reach: 84 };
  const there = (shape) => reaches(shape, ([u, v]) => [2 * u, 2 * v], 2, box);
  assert.ok(there({ points: [[-900, -900], [900, 900]] })); // across, with both ends outside
  assert.ok(!there({ points: [[-900, 60], [900, 60]] }));
  assert.ok(there({ points: [[-900, 60], [900, 60]], halfWidth: [1, 20] }));
  assert.ok(there({ points: [[70, 0]], radius: 30 }));
  assert.ok(!there({ points: [[70, 0]], radius: 5 }));
  assert.ok(there({ points: [[50, 0]] })); // its mark has a size on the screen
  assert.ok(!there({ points: [] }));
});

test("a wire has its arrow head while it is shown: not a drilled part of it, nor over an image that is out of date", () => {
  const points = [[0, 0], [100, 0]];
  assert.ok(hasDirection({ style: "wire", points }, false));
  assert.ok(!hasDirection({ style: "wire", points }, true));
  assert.ok(!hasDirection({ style: "found", points }, false));
  assert.ok(!hasDirection({ style: "wire", points: [] }, false));
});
