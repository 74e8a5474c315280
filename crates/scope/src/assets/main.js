// The page: joins the connection, the samples, the trigger, the plots and what stands next to them.

import { Cursors } from "./cursors.js";
import { csv, toMcap } from "./export.js";
import { keep, layout } from "./layout.js";
import { Link } from "./link.js";
import { Operate } from "./operate.js";
import { MOST_SIGNALS, Plot, digits } from "./plot.js";
import * as panel from "./panel.js";
import { Store } from "./store.js";
import { Trigger } from "./trigger.js";
import { View } from "./view.js";

const WINDOWS = [0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30, 60];
/** Events that are marked in the plots. */
const MOST_EVENTS = 500;

const get = (id) => document.getElementById(id);

const store = new Store();
const trigger = new Trigger();

const scope = {
  machine: null,
  store,
  trigger,
  view: new View(store, trigger),
  plots: [],
  events: [],
  lost: { frames: 0, records: 0, dropped: 0 },

  nameOf(id) {
    const { axis, name } = this.machine.signals[id];
    return axis === null ? name : `${this.machine.axes[axis].name} ${name}`;
  },

  /** The place of a sample at an instant, or the last before it. */
  placeAt(time) {
    const { data } = this.view;
    return Math.min(Math.max(data.at(time), data.oldest), data.written - 1);
  },

  valueAt(id, time) {
    const { data } = this.view;
    return data.written ? data.max(id, this.placeAt(time)) : NaN;
  },

  textAt(id, time) {
    const value = this.valueAt(id, time);
    const { name } = this.machine.signals[id];
    return this.machine.names[name]?.[value] ?? digits(value);
  },

  shownRange() {
    const { from, to, origin, span } = this.view;
    return Number.isNaN(from) ? [-span, 0] : [from - origin, to - origin];
  },

  /** The signals of all plots. */
  get drawn() {
    return new Set(this.plots.flatMap((plot) => plot.signals));
  },

  /** The same, and that of the trigger. */
  get signals() {
    const ids = this.drawn;
    if (typeof trigger.source === "number") ids.add(trigger.source);
    return ids;
  },

  /** Other signals are shown. */
  changed() {
    const ids = this.signals;
    store.keep(ids);
    link.show(ids);
    keep(this.machine, this.plots);
    listSources();
  },

  addPlot(signals) {
    const plot = new Plot(this, signals.slice(0, MOST_SIGNALS));
    this.plots.push(plot);
    get("plots").append(plot.element);
    return plot;
  },

  removePlot(plot) {
    this.plots = this.plots.filter((other) => other !== plot);
    plot.remove();
    this.changed();
  },

  draw() {
    this.cursors.follow();
    for (const plot of this.plots) plot.draw();
  },

  zoom(from, to) {
    this.view.zoom(from, to);
    this.show();
  },

  zoomBy(factor, around) {
    this.view.zoomBy(factor, around);
    this.show();
  },

  pan(share) {
    this.view.pan(share);
    this.show();
  },

  fit() {
    this.view.fit();
    this.show();
  },

  show() {
    showRun();
    this.draw();
  },

  setCursor(name, time) {
    this.cursors.set(name, time);
    this.draw();
  },
};
scope.cursors = new Cursors(scope);

// ---- what comes

const link = new Link({
  message(message) {
    if (message.control !== undefined) operate.allow(message.control);
    if (message.operated) operate.answer(message.operated);
    if (message.machine) attach(message.machine);
    if (message.waiting !== undefined) wait(message.waiting);
    if (!scope.machine) return;
    if (message.axes) panel.axes(message.axes, scope.machine);
    if (message.events) {
      scope.events = [...scope.events, ...message.events].slice(-MOST_EVENTS);
      message.events.forEach((event) => trigger.event(event));
      panel.events(message.events, scope.machine);
    }
    if (message.late) {
      panel.late(message.late, message.late_count, scope.machine);
      scope.lost.records = message.lost;
      scope.lost.dropped = message.dropped;
      panel.lost(scope.lost);
    }
    if (message.frames_lost) {
      scope.lost.frames = message.frames_lost;
      panel.lost(scope.lost);
    }
  },
  samples(buffer) {
    // What is held is not overwritten.
    if (!scope.machine || (scope.view.held && !scope.view.shot)) return;
    store.enter(buffer);
    panel.resolution(store.width, scope.machine);
  },
  closed(why) {
    panel.status("gone", why);
    operate.lost();
  },
});
const operate = new Operate(link);

function attach(machine) {
  panel.status("live", "connected");
  const isSame = scope.machine && scope.machine.pid === machine.pid && scope.machine.epoch_ns === machine.epoch_ns;
  if (isSame) return;
  scope.machine = machine;
  store.clear();
  scope.events = [];
  scope.lost = { frames: 0, records: 0, dropped: 0 };
  scope.view.reset();
  panel.machine(machine);
  panel.lost(scope.lost);
  for (const plot of scope.plots) plot.remove();
  scope.plots = [];
  trigger.source = null;
  layout(machine).forEach((signals) => scope.addPlot(signals));
  scope.changed();
  showRun();
}

function wait(why) {
  panel.status("wait", `waiting for the master: ${why}`);
}

// ---- the bar

for (const span of WINDOWS) {
  get("window").append(new Option(span < 1 ? `${span * 1000} ms` : `${span} s`, span, span === 2, span === 2));
}

function listSources() {
  const select = get("source");
  const chosen = trigger.source;
  const shown = document.createElement("optgroup");
  shown.label = "Signals shown";
  for (const id of [...scope.signals].sort((a, b) => a - b)) shown.append(new Option(scope.nameOf(id), id));
  const happens = document.createElement("optgroup");
  happens.label = "Events";
  happens.append(new Option("any event", "event"), new Option("fault or stop", "fault"));
  select.replaceChildren(shown, happens);
  const first = shown.firstElementChild ? Number(shown.firstElementChild.value) : "event";
  trigger.source = chosen ?? first;
  select.value = trigger.source;
  showTrigger();
}

function showTrigger() {
  const isSignal = typeof trigger.source === "number";
  get("edge-label").hidden = get("level-label").hidden = !isSignal;
}

function showRun() {
  const { held } = scope.view;
  get("run").textContent = held ? "Run" : "Hold";
  get("run").classList.toggle("held", held);
  const [text, kind] = describe();
  const state = get("trigger-state");
  if (state.textContent !== text) state.textContent = text;
  state.className = kind;
}

function describe() {
  const { view } = scope;
  const at = () => `cycle ${view.data.cycle(scope.placeAt(view.origin))}`;
  if (view.held) return [view.triggered ? `held, ${at()}` : "held", "done"];
  if (trigger.single) return ["armed, single", "armed"];
  if (trigger.mode === "off") return ["roll", ""];
  if (view.triggered && (view.shot || trigger.at !== null)) return [`at ${at()}`, "done"];
  return [trigger.mode === "auto" ? "auto, no trigger" : "armed", "armed"];
}

const act = {
  run() {
    if (scope.view.held) scope.view.run();
    else scope.view.hold();
    scope.show();
  },
  single() {
    scope.view.single();
    scope.show();
  },
  cursors() {
    scope.cursors.toggle();
    scope.draw();
  },
  reset: () => scope.fit(),
  add() {
    scope.addPlot([]);
    scope.changed();
  },
  csv: () => csv(scope, [...scope.drawn]),
  mcap: () => toMcap(scope, [...scope.drawn]),
};
for (const [id, handler] of Object.entries(act)) get(id).onclick = () => scope.machine && handler();

const choose = {
  window: (value) => (scope.view.span = Number(value)),
  mode: (value) => (trigger.mode = value),
  source(value) {
    trigger.source = Number.isNaN(Number(value)) ? value : Number(value);
    showTrigger();
    scope.changed();
  },
  edge: (value) => (trigger.edge = value),
  level: (value) => (trigger.level = Number(value) || 0),
  pre: (value) => (trigger.pre = Number(value)),
};
for (const [id, handler] of Object.entries(choose)) {
  get(id).onchange = ({ target }) => {
    handler(target.value);
    if (!scope.machine) return;
    scope.view.run();
    scope.show();
  };
}

// ---- keys

document.addEventListener("keydown", (event) => {
  if (!scope.machine || event.ctrlKey || event.metaKey) return;
  const isField = /^(INPUT|SELECT)$/.test(event.target.tagName);
  const isButton = event.target.tagName === "BUTTON";
  if (isField || (isButton && event.key === " ")) return;
  const cursor = event.altKey && (event.shiftKey ? "b" : "a");
  const nudge = (share) => {
    scope.cursors.nudge(cursor, share);
    scope.draw();
  };
  const keys = {
    " ": act.run,
    s: act.single,
    c: act.cursors,
    "+": () => scope.zoomBy(0.8),
    "=": () => scope.zoomBy(0.8),
    "-": () => scope.zoomBy(1.25),
    ArrowLeft: () => (cursor ? nudge(-0.005) : scope.pan(-0.1)),
    ArrowRight: () => (cursor ? nudge(0.005) : scope.pan(0.1)),
    Escape: () => scope.fit(),
  };
  const handler = keys[event.key];
  if (!handler) return;
  event.preventDefault();
  handler();
});

// ---- drawing

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () =>
  scope.plots.forEach((plot) => plot.build()),
);

let drawnAt = 0;
function frame(now) {
  requestAnimationFrame(frame);
  // Thirty times a second is as much as an eye needs.
  if (!scope.machine || now - drawnAt < 32) return;
  drawnAt = now;
  if (scope.view.follow()) scope.draw();
  showRun();
}
requestAnimationFrame(frame);

// For a console, and for tests.
globalThis.scope = scope;
