// What is seen, as a file: the samples between the edges of the plots, of the signals that they have.

import { mcap } from "./mcap.js";

function save(bytes, type, ending) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([bytes], { type }));
  link.download = `fieldbeat-${new Date().toISOString().slice(0, 19).replaceAll(/[-:]/g, "")}.${ending}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

const number = (value) => (Number.isNaN(value) ? "" : String(value));

/** A column for each signal, two where envelopes are seen. */
export function csv(scope, ids) {
  const { view } = scope;
  const { data } = view;
  const [first, last] = view.range;
  const isEnvelope = data.hasEnvelopes(first, last);
  const columns = ids.flatMap((id) => {
    const unit = scope.machine.signals[id].unit;
    const name = unit ? `${scope.nameOf(id)} [${unit}]` : scope.nameOf(id);
    const least = (index) => data.min(id, index);
    if (!isEnvelope) return [[name, least]];
    return [
      [`${name} min`, least],
      [`${name} max`, (index) => data.max(id, index)],
    ];
  });
  const lines = [["time [s]", "cycle", ...columns.map(([name]) => `"${name.replaceAll('"', '""')}"`)].join(",")];
  for (let index = first; index < last; index++) {
    const time = (data.time(index) - view.origin).toFixed(9);
    lines.push([time, data.cycle(index), ...columns.map(([, value]) => number(value(index)))].join(","));
  }
  save(`${lines.join("\n")}\n`, "text/csv", "csv");
}

/** A topic for each axis and for the loop, named as in a recording, at the date of the samples. */
export function toMcap(scope, ids) {
  const { view, machine } = scope;
  const { data } = view;
  const [first, last] = view.range;
  const isEnvelope = data.hasEnvelopes(first, last);
  const names = (name) => (isEnvelope ? [`${name}_min`, `${name}_max`] : [name]);
  const groups = Map.groupBy(ids, (id) => machine.signals[id].axis);
  const topic = (axis) => (axis === null ? "/cycle" : `/axes/${machine.axes[axis].name}`);
  const key = (id) => {
    const { name, unit } = machine.signals[id];
    return name.replaceAll(/[^a-zA-Z0-9]+/g, "_") + (unit === machine.time_unit ? `_${unit}` : "");
  };
  const channels = [...groups].map(([axis, of]) => ({
    topic: topic(axis),
    of,
    units: Object.fromEntries(
      of.filter((id) => machine.signals[id].unit).map((id) => [key(id), machine.signals[id].unit]),
    ),
    schema: {
      type: "object",
      properties: Object.fromEntries(
        of
          .flatMap((id) => {
            const about = { type: ["number", "null"], description: machine.signals[id].unit };
            return names(key(id)).map((name) => [name, about]);
          })
          .concat([["cycle", { type: "integer" }]]),
      ),
    },
  }));
  const epoch = BigInt(machine.epoch_ns);
  const messages = [];
  for (let index = first; index < last; index++) {
    const time = epoch + BigInt(Math.round(data.time(index) * 1e9));
    channels.forEach(({ of }, channel) => {
      const value = { cycle: data.cycle(index) };
      for (const id of of) {
        const [least, greatest] = names(key(id));
        value[least] = nullable(data.min(id, index));
        if (greatest) value[greatest] = nullable(data.max(id, index));
      }
      messages.push({ channel, time, value });
    });
  }
  save(mcap(channels, messages), "application/octet-stream", "mcap");
}

const nullable = (value) => (Number.isNaN(value) ? null : value);
