// Which signals are in which plot: as a browser has kept it for a configuration, or else the usual ones.

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
  return kept(machine) ?? machine.plots;
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
