// Which signals are in which plot: as a browser has kept it for a configuration, or else the first axes and the loop.

const key = (machine) => `fieldbeat-scope:${machine.config}`;

function find(machine, axis, name) {
  return machine.signals.findIndex((signal) => signal.axis === axis && signal.name === name);
}

/** The plots as they were left; `null` where nothing was kept. */
function kept(machine) {
  try {
    const axis = (name) => (name === null ? null : machine.axes.findIndex((axis) => axis.name === name));
    const plots = JSON.parse(localStorage.getItem(key(machine)));
    const known = plots.map((plot) => plot.map(([of, name]) => find(machine, axis(of), name)).filter((id) => id >= 0));
    const filled = known.filter((plot) => plot.length);
    return filled.length ? filled : null;
  } catch {
    return null;
  }
}

/** The signals of each plot. */
export function layout(machine) {
  const shown = machine.axes.slice(0, 2).map((_, axis) => axis);
  const of = (...names) => shown.flatMap((axis) => names.map((name) => find(machine, axis, name)));
  const loop = ["wake-up", "end"].map((name) => find(machine, null, name));
  const usual = [of("demand", "position"), of("following error"), of("velocity"), loop];
  return kept(machine) ?? usual.map((plot) => plot.filter((id) => id >= 0)).filter((plot) => plot.length);
}

/** Keeps the plots for the next time. */
export function keep(machine, plots) {
  const { signals, axes } = machine;
  const named = (id) => [signals[id].axis === null ? null : axes[signals[id].axis].name, signals[id].name];
  try {
    localStorage.setItem(key(machine), JSON.stringify(plots.map((plot) => plot.signals.map(named))));
  } catch {
    // A browser that keeps nothing shows the first axes again.
  }
}
