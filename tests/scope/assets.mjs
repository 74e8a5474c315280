// The trigger, the cursors and what they look at, over samples that are made here, without a browser.

import assert from "node:assert/strict";
import { test } from "node:test";

import { Cursors } from "../../crates/scope/src/assets/cursors.js";
import { Store } from "../../crates/scope/src/assets/store.js";
import { Trigger } from "../../crates/scope/src/assets/trigger.js";
import { View } from "../../crates/scope/src/assets/view.js";

/** What a browser is for the link: its address, its history, its sockets and its answers. */
function browser(hash, answers) {
  const seen = { replaced: [], sockets: [], fetched: [], listeners: {} };
  globalThis.location = { hash, host: "localhost:1", pathname: "/", search: "" };
  globalThis.history = {
    replaceState(state, title, address) {
      seen.replaced.push(address);
      location.hash = "";
    },
  };
  globalThis.addEventListener = (name, handler) => (seen.listeners[name] = handler);
  globalThis.WebSocket = class {
    constructor(url, protocols) {
      Object.assign(this, { url, protocols, closed: false });
      seen.sockets.push(this);
    }
    close() {
      this.closed = true;
    }
  };
  globalThis.fetch = async (path, { headers }) => {
    seen.fetched.push([path, headers]);
    return answers;
  };
  return seen;
}

test("the token leaves the address at once, and is named to the websocket and nowhere else", async () => {
  const refused = { ok: false, text: async () => "open the address\n" };
  const seen = browser("#token=0a1b", refused);
  const { Link } = await import("../../crates/scope/src/assets/link.js");
  assert.deepEqual(seen.replaced, ["/"]);
  const reasons = [];
  const link = new Link({ closed: (why) => reasons.push(why) });
  assert.deepEqual(
    seen.sockets.map(({ url, protocols }) => [url, protocols]),
    [["ws://localhost:1/ws", ["fieldbeat", "0a1b"]]],
  );
  // Refused: the page says why.
  await seen.sockets[0].onclose({ code: 1006 });
  assert.deepEqual(seen.fetched, [["access", { Authorization: "Bearer 0a1b" }]]);
  assert.deepEqual(reasons, ["refused: open the address"]);
  // Another token, for the page that is open: the next connection names it.
  location.hash = "#token=2c3d";
  seen.listeners.hashchange();
  assert.equal(seen.sockets.at(-1).closed, true);
  link.open();
  assert.deepEqual([seen.sockets.at(-1).protocols, location.hash], [["fieldbeat", "2c3d"], ""]);
  // A place in the page is no token.
  location.hash = "#axes";
  seen.listeners.hashchange();
  assert.deepEqual([seen.sockets.at(-1).closed, seen.replaced.length], [false, 2]);
});

/** A power of two: instants are exact. */
const PERIOD = 1 / 1024;
const ID = 7;

/** A frame of samples from this one on; pairs of least and greatest are envelopes of so many cycles. */
function frame(first, values, cycles = 1) {
  const each = cycles > 1 ? 2 : 1;
  const buffer = new ArrayBuffer(16 + 8 * values.length * (2 + each));
  const head = new DataView(buffer);
  head.setUint8(0, 2);
  head.setUint8(1, cycles);
  head.setUint16(2, 1, true);
  head.setUint32(4, values.length, true);
  head.setUint32(8, ID, true);
  const numbers = new Float64Array(buffer, 16);
  const columns = [(place) => (first + place) * PERIOD, (place) => first + place];
  columns.push(...(cycles > 1 ? [0, 1].map((end) => (place) => values[place][end]) : [(place) => values[place]]));
  columns.forEach((of, column) => values.forEach((_, place) => (numbers[column * values.length + place] = of(place))));
  return buffer;
}

/** A store of one signal, its trigger with these settings, and a view of 256 samples. */
function scope(settings = {}) {
  const store = new Store(4096);
  store.keep(new Set([ID]));
  const trigger = Object.assign(new Trigger(), { mode: "normal", source: ID, pre: 0, ...settings });
  const view = new View(store, trigger);
  view.span = 256 * PERIOD;
  const enter = (values, cycles) => store.enter(frame(store.written, values, cycles));
  return { store, trigger, view, enter };
}

/** The sample at which an acquisition triggers; null: none does. */
function triggers(settings, values, cycles) {
  const { store, trigger, view, enter } = scope(settings);
  enter(values, cycles);
  const at = trigger.look(store, view.span);
  return at === null ? null : at / PERIOD;
}

/** Zero, then these values. */
const after = (...values) => [...Array(10).fill(0), ...values];

for (const [edge, level, values, expected] of [
  ["rising", 5, after(4, 5, 6), 11],
  ["rising", 5, after(4, 4.9), null],
  // It begins above: that is no edge.
  ["rising", -1, after(1), null],
  ["rising", 5, after(9, 0, 9), 10],
  ["falling", -5, after(-4, -5, -6), 11],
  ["falling", -5, after(-4.9, 4), null],
  ["falling", 1, after(1, 0), null],
  ["falling", 5, after(9, 6, 5, 4), 12],
  ["above", 5, after(5, 5.1), 11],
  ["above", 5, after(5), null],
  ["above", -1, after(), 1],
  ["below", -5, after(-5, -5.1), 11],
  ["below", -5, after(-5), null],
  ["below", 1, after(), 1],
  // Nothing is known: no value is there, and none on the other side of an edge.
  ["rising", 5, after(NaN, 9), null],
  ["falling", -5, after(NaN, -9), null],
  ["above", 5, after(NaN, NaN), null],
  ["below", 5, Array(10).fill(NaN), null],
]) {
  test(`${edge} ${level} at ${expected} of ${values}`, () => {
    assert.equal(triggers({ edge, level }, values), expected);
  });
}

test("a peak within an envelope triggers", () => {
  const values = after().map(() => [0, 1]);
  values.push([0, 9], [-9, 1]);
  for (const [edge, level, expected] of [
    ["rising", 5, 10],
    ["above", 5, 10],
    ["falling", -5, 11],
    ["below", -5, 11],
  ]) {
    assert.equal(triggers({ edge, level }, values, 10), expected, edge);
  }
  // Each of them crosses the level.
  const crossing = after().map(() => [-9, 9]);
  for (const edge of ["rising", "falling"]) assert.equal(triggers({ edge, level: 5 }, crossing, 10), 1, edge);
});

for (const [pre, before] of [
  [0, 0],
  [0.25, 64],
  [0.5, 128],
  [0.75, 192],
]) {
  test(`${before} samples are before the trigger`, () => {
    const { view, enter } = scope({ edge: "rising", level: 500, pre });
    // The first edge comes before so many samples are there.
    enter(Array.from({ length: 1024 }, (_, index) => (index === 40 ? 600 : index)));
    assert.ok(view.follow());
    const { data } = view;
    const at = data.at(view.origin);
    assert.deepEqual([view.triggered, data.cycle(at)], [true, pre ? 500 : 40]);
    const [first, last] = view.range;
    assert.deepEqual([at - first, last - first], [before, 257]);
  });
}

test("an acquisition is shown when it is whole, and the next one follows it", () => {
  const { view, trigger, enter } = scope({ edge: "rising", level: 1, pre: 0.25 });
  const edges = (count) => Array.from({ length: count }, (_, index) => index % 200 >= 100);
  enter(edges(200));
  assert.equal(view.follow(), false);
  enter(edges(200));
  assert.ok(view.follow());
  assert.deepEqual([view.origin / PERIOD, view.data === view.store], [100, false]);
  assert.equal(trigger.at, null);
  // From 292 on, with what is to be before it already taken.
  enter(edges(400));
  assert.ok(view.follow());
  assert.equal(view.origin / PERIOD, 300);
});

test("a single acquisition holds", () => {
  const { view, enter } = scope({ edge: "rising", level: 1, mode: "off" });
  view.single();
  enter(after(1, ...Array(300).fill(1)));
  assert.ok(view.follow());
  assert.deepEqual([view.held, view.triggered, view.origin / PERIOD], [true, true, 10]);
  enter(after(1));
  assert.equal(view.follow(), false);
});

test("any event triggers, or a fault alone", () => {
  const happened = [
    { t: 100 * PERIOD, fault: false },
    { t: 200 * PERIOD, fault: true },
  ];
  for (const [source, expected] of [
    ["event", 100],
    ["fault", 200],
    // A signal waits for none.
    [ID, null],
  ]) {
    const { store, trigger, view, enter } = scope({ source, edge: "rising", level: 1 });
    enter(after());
    happened.forEach((event) => trigger.event(event));
    // Its samples have not come yet.
    assert.equal(trigger.look(store, view.span), null);
    enter(Array(1000).fill(0));
    assert.equal(trigger.look(store, view.span), expected && expected * PERIOD, source);
  }
});

test("auto rolls while nothing triggers, normal waits, off always rolls", () => {
  for (const [mode, rolls] of [
    ["auto", true],
    ["normal", false],
    ["off", true],
  ]) {
    const { view, enter } = scope({ edge: "rising", level: 1, mode });
    enter(after());
    assert.equal(view.follow(), mode === "off", mode);
    enter(Array(1024).fill(0));
    assert.equal(view.follow(), rolls, mode);
    assert.deepEqual([view.triggered, view.to / PERIOD], [false, rolls ? 1033 : NaN], mode);
    // It shows the trigger that comes all the same.
    enter(after(1, ...Array(300).fill(1)));
    view.follow();
    assert.deepEqual([view.triggered, view.origin / PERIOD], mode === "off" ? [false, 1344] : [true, 1044], mode);
  }
});

test("cursors measure the values at both, and their differences", () => {
  const { store, view, enter } = scope({ mode: "off" });
  enter(Array.from({ length: 512 }, (_, index) => 2 * index));
  view.follow();
  const cursors = new Cursors({
    view,
    drawn: new Set([ID]),
    machine: { signals: { [ID]: { unit: "mm" } } },
    nameOf: () => "d0 position",
    valueAt: (id, time) => store.max(id, store.at(time)),
    textAt: (id, time) => String(store.max(id, store.at(time))),
  });
  Object.assign(cursors, { on: true, a: 300 * PERIOD, b: 428 * PERIOD, from: view.from });
  const [, time, frequency, position] = cursors.rows();
  assert.deepEqual(time, ["time", "-206.055 ms", "-81.055 ms", "125.000 ms"]);
  assert.deepEqual(frequency, ["frequency", "", "", "8.000 Hz"]);
  assert.deepEqual(position, ["d0 position", "600", "856", "256.00 mm"]);
  // The other way round.
  cursors.set("a", 430 * PERIOD);
  assert.deepEqual(cursors.rows()[3], ["d0 position", "860", "856", "-4.000 mm"]);
  cursors.set("a", cursors.b);
  assert.deepEqual(cursors.rows()[2], ["frequency", "", "", "–"]);
});

test("samples say whether they are envelopes, also after others", () => {
  const { store, enter } = scope();
  enter([1, 2]);
  assert.deepEqual([store.width, store.hasEnvelopes(0, 2)], [1, false]);
  enter([[3, 4]], 8);
  assert.deepEqual([store.width, store.hasEnvelopes(0, 2), store.hasEnvelopes(0, 3)], [8, false, true]);
  enter([5]);
  assert.deepEqual([store.width, store.hasEnvelopes(2, 4), store.hasEnvelopes(3, 4)], [1, true, false]);
  const values = (of) => [0, 1, 2, 3].map((index) => [of.min(ID, index), of.max(ID, index)]);
  const expected = [[1, 1], [2, 2], [3, 4], [5, 5]];
  assert.deepEqual(values(store), expected);
  assert.deepEqual(values(store.copy(0, 4)), expected);
  assert.deepEqual([store.copy(0, 4).hasEnvelopes(2, 3), store.copy(0, 4).width], [true, 1]);
});
