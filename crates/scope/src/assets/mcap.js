// An MCAP file (mcap.dev/spec) of JSON messages: one chunk, not compressed, with its index.

const MAGIC = [0x89, 0x4d, 0x43, 0x41, 0x50, 0x30, 0x0d, 0x0a];
const OP = {
  header: 1,
  footer: 2,
  schema: 3,
  channel: 4,
  message: 5,
  chunk: 6,
  index: 7,
  chunkIndex: 8,
  statistics: 11,
  dataEnd: 15,
};
const encoder = new TextEncoder();

class Bytes {
  constructor() {
    this.bytes = new Uint8Array(1 << 16);
    this.view = new DataView(this.bytes.buffer);
    this.length = 0;
  }

  room(count) {
    if (this.length + count <= this.bytes.length) return;
    const larger = new Uint8Array(Math.max(2 * this.bytes.length, this.length + count));
    larger.set(this.bytes);
    this.bytes = larger;
    this.view = new DataView(larger.buffer);
  }

  raw(bytes) {
    this.room(bytes.length);
    this.bytes.set(bytes, this.length);
    this.length += bytes.length;
    return this;
  }

  u16(value) {
    this.room(2);
    this.view.setUint16(this.length, value, true);
    this.length += 2;
    return this;
  }

  u32(value) {
    this.room(4);
    this.view.setUint32(this.length, value, true);
    this.length += 4;
    return this;
  }

  u64(value) {
    this.room(8);
    this.view.setBigUint64(this.length, BigInt(value), true);
    this.length += 8;
    return this;
  }

  text(text) {
    const bytes = encoder.encode(text);
    return this.u32(bytes.length).raw(bytes);
  }

  /** A map or an array: its length in bytes, and what `fill` writes. */
  list(fill) {
    const inner = new Bytes();
    fill(inner);
    return this.u32(inner.length).raw(inner.done());
  }

  record(op, fill) {
    const inner = new Bytes();
    fill(inner);
    this.raw([op]).u64(inner.length);
    return this.raw(inner.done());
  }

  done() {
    return this.bytes.subarray(0, this.length);
  }
}

/**
 * `channels`: topic, schema and units of each; `messages`: channel, time (ns since 1970, a BigInt) and value of each,
 * in the order of their times.
 */
export function mcap(channels, messages) {
  const declare = (to) => {
    channels.forEach(({ topic, schema, units }, index) => {
      to.record(OP.schema, (r) =>
        r
          .u16(index + 1)
          .text(`fieldbeat${topic.replaceAll("/", ".")}`)
          .text("jsonschema")
          .text(JSON.stringify(schema)),
      );
      to.record(OP.channel, (r) =>
        r
          .u16(index)
          .u16(index + 1)
          .text(topic)
          .text("json")
          .list((l) => Object.entries(units).forEach(([field, unit]) => l.text(`unit_${field}`).text(unit))),
      );
    });
  };
  const chunk = new Bytes();
  declare(chunk);
  const places = channels.map(() => []);
  messages.forEach(({ channel, time, value }, sequence) => {
    places[channel].push([time, chunk.length]);
    const data = encoder.encode(JSON.stringify(value));
    chunk
      .raw([OP.message])
      .u64(22 + data.length)
      .u16(channel)
      .u32(sequence)
      .u64(time)
      .u64(time)
      .raw(data);
  });
  const [begin, end] = messages.length ? [messages[0].time, messages[messages.length - 1].time] : [0n, 0n];

  const file = new Bytes();
  file.raw(MAGIC).record(OP.header, (r) => r.text("").text("fieldbeat scope"));
  const chunkAt = file.length;
  file.record(OP.chunk, (r) =>
    r.u64(begin).u64(end).u64(chunk.length).u32(0).text("").u64(chunk.length).raw(chunk.done()),
  );
  const chunkLength = file.length - chunkAt;
  const indexAt = places.map((list, channel) => {
    const at = file.length;
    file.record(OP.index, (r) => r.u16(channel).list((l) => list.forEach(([time, place]) => l.u64(time).u64(place))));
    return at;
  });
  const indexLength = file.length - chunkAt - chunkLength;
  file.record(OP.dataEnd, (r) => r.u32(0));
  const summaryAt = file.length;
  declare(file);
  file.record(OP.statistics, (r) =>
    r
      .u64(messages.length)
      .u16(channels.length)
      .u32(channels.length)
      .u32(0)
      .u32(0)
      .u32(1)
      .u64(begin)
      .u64(end)
      .list((l) => places.forEach((list, channel) => l.u16(channel).u64(list.length))),
  );
  file.record(OP.chunkIndex, (r) =>
    r
      .u64(begin)
      .u64(end)
      .u64(chunkAt)
      .u64(chunkLength)
      .list((l) => indexAt.forEach((at, channel) => l.u16(channel).u64(at)))
      .u64(indexLength)
      .text("")
      .u64(chunk.length)
      .u64(chunk.length),
  );
  file.record(OP.footer, (r) => r.u64(summaryAt).u64(0).u32(0));
  return file.raw(MAGIC).done();
}
