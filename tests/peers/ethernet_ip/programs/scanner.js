// A class 1 scanner made of st-ethernet-ip for the assemblies of a MOONS' drive: scanner.js ADDRESS LOCAL RPI_MS.
//
// It answers each line on standard input by one. "error ..." is an exception.
//
//     outputs NUMBER...      from here on the output assembly begins with these 32-bit numbers
//     inputs COUNT           the input assembly as it came last: so many 32-bit numbers
//     packets                how many came on the connection, and how many of those had another size, or did not have
//                            the next sequence number
//     close                  Forward_Close
//
// It sends one packet for each that comes, and none by itself.

const path = require("path");
const readline = require("readline");

const library = path.join(__dirname, "../../../../target/peers/node_modules/st-ethernet-ip");
const { IO } = require(library);

const [address, local, rpi] = process.argv.slice(2);
const config = {
    configInstance: { assembly: 0x66, size: 0 },
    outputInstance: { assembly: 0x70, size: 64 },
    inputInstance: { assembly: 0x65, size: 56 },
};
// Two items, sequence count, assembly.
const SIZE = 18 + 2 + 56;

const scanner = new IO.Scanner(2222, local);
const connection = scanner.addConnection(config, Number(rpi), address);

let [packets, other, jumps, last] = [0, 0, 0, null];
scanner.socket.on("message", (data) => {
    if (connection.TOid === 0 || data.readUInt32LE(6) !== connection.TOid) return;
    const sequence = data.readUInt32LE(10);
    packets += 1;
    if (data.length !== SIZE) other += 1;
    if (last !== null && sequence !== (last + 1) % 2 ** 32) jumps += 1;
    last = sequence;
});

async function answer([what, ...numbers]) {
    switch (what) {
        case "outputs":
            numbers.forEach((number, at) => connection.outputData.writeInt32LE(Number(number), 4 * at));
            return [];
        case "inputs":
            return [...Array(Number(numbers[0])).keys()].map((at) => connection.inputData.readInt32LE(4 * at));
        case "packets":
            return [packets, other, jumps];
        case "close":
            connection.run = false;
            await connection.tcpController.disconnect();
            return [];
    }
    throw new Error(what);
}

function ready() {
    if (connection.TOid === 0) return setTimeout(ready, 10);
    console.log("ready");
    const lines = readline.createInterface({ input: process.stdin });
    lines.on("line", (line) =>
        answer(line.split(" ")).then(
            (words) => console.log(["ok", ...words].join(" ")),
            (error) => console.log(`error ${error.message ?? JSON.stringify(error)}`),
        ),
    );
    lines.on("close", () => process.exit());
}
ready();
