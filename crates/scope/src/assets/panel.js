// What stands next to the plots: the state of the connection, the axes, late cycles and events.

import { digits } from "./plot.js";

const MOST_LINES = 200;
const get = (id) => document.getElementById(id);

function element(name, text, kind) {
  const made = document.createElement(name);
  made.textContent = text;
  if (kind) made.className = kind;
  return made;
}

/** The line at the top. `kind` is live, wait or gone. */
export function status(kind, text) {
  get("dot").className = kind;
  get("status-text").textContent = text;
}

export function machine(of) {
  const config = of.config ?? "a machine built in code";
  get("machine").textContent = `${config.split("/").pop()}, ${of.period_ns / 1e6} ms, pid ${of.pid}, ${of.version}`;
  get("machine").title = config;
  for (const id of ["late", "events"]) get(id).replaceChildren(element("li", "none yet", "none"));
  get("late-count").textContent = "";
  const rows = of.axes.map(({ name }) => {
    const row = document.createElement("tr");
    const head = element("th", name);
    head.scope = "row";
    row.append(head, element("td", "–", "state"), element("td", "–", "n"), element("td", "–", "n"));
    return row;
  });
  get("axes").tBodies[0].replaceChildren(...rows);
}

/** The state of each axis, in words. */
export function axes(states, of) {
  const rows = get("axes").tBodies[0].rows;
  states.forEach((state, index) => {
    if (!state || !rows[index]) return;
    const [, cell, position, error] = rows[index].cells;
    const shown = JSON.stringify([
      state.link,
      state.state,
      state.command,
      state.stopped,
      state.fault,
      state.warning,
      state.sto_open,
    ]);
    if (cell.dataset.shown !== shown) {
      cell.dataset.shown = shown;
      const isUp = state.link === "online";
      const kind = !isUp || state.state === "Fault" ? "bad" : state.state === "OperationEnabled" ? "good" : "";
      cell.replaceChildren(element("span", isUp ? state.state : `link ${state.link}`, kind));
      const notes = [
        state.command && [state.command, ""],
        state.stopped && [`stopped: ${state.stopped}`, "warn"],
        state.fault && [`fault ${state.fault}`, "bad"],
        state.warning && [`warning ${state.warning}`, "warn"],
        state.sto_open && ["hardware enable (STO) missing", "warn"],
      ];
      for (const [text, kind] of notes.filter(Boolean)) {
        const note = document.createElement("small");
        note.append(element("span", text, kind));
        cell.append(note);
      }
    }
    position.textContent = state.position === null ? "–" : `${digits(state.position)} ${of.axes[index].unit}`;
    error.textContent = state.error === null ? "–" : digits(state.error);
  });
}

function add(id, items, line) {
  const list = get(id);
  list.querySelector(".none")?.remove();
  for (const item of items) list.prepend(line(item));
  while (list.childElementCount > MOST_LINES) list.lastElementChild.remove();
}

function dated(t, of) {
  const date = new Date(Number(BigInt(of.epoch_ns) / 1000000n) + t * 1000);
  const time = element("time", `${date.toTimeString().slice(0, 8)}.${String(date.getMilliseconds()).padStart(3, "0")}`);
  return time;
}

export function events(list, of) {
  add("events", list, ({ t, cycle, axis, text, fault }) => {
    const line = document.createElement("li");
    line.title = `cycle ${cycle}`;
    const who = axis === null ? "loop" : of.axes[axis].name;
    line.append(dated(t, of), element("span", `${who}: ${text}`, fault ? "bad" : ""));
    return line;
  });
}

export function late(list, count, of) {
  get("late-count").textContent = `${count}, above ${of.late_ns / 1000} us`;
  if (!list.length) return;
  add("late", list, ({ t, cycle, ns, text }) => {
    const line = document.createElement("li");
    line.title = `cycle ${cycle}`;
    line.append(dated(t, of), element("span", ns ? `${(ns / 1000).toFixed(0)} us: ${text}` : text));
    return line;
  });
}

/** What did not arrive: here, at the scope, or in the master. */
export function lost({ frames = 0, records = 0, dropped = 0 }) {
  const parts = [
    frames && `${frames} frames lost: this browser is too slow`,
    records && `${records} records lost: the scope is too slow`,
    dropped && `${dropped} records lost in the master`,
  ].filter(Boolean);
  get("lost").hidden = !parts.length;
  get("lost").textContent = parts.join("; ");
}

/** Whether each cycle is shown, or what several of them have in common. */
export function resolution(cycles, of) {
  const text = cycles > 1 ? `least and greatest of ${+((cycles * of.period_ns) / 1e6).toFixed(3)} ms` : "each cycle";
  if (get("resolution").textContent !== text) get("resolution").textContent = text;
}
