// Drives Chromium by lines: a word, a space, and what it is about. Each is answered by one line of JSON.
//
//   open URL         loads the page
//   eval EXPRESSION  its value in the page
//   wait EXPRESSION  waits until it holds
//   click SELECTOR   clicks it
//   set SELECTOR VALUE  chooses or types it
//   key KEY          presses it
//   drag FROM TO     from one share of the width of the first plot to another, with the mouse
//   save SELECTOR FILE  clicks it, and keeps the file that is downloaded
//   look FILE WIDTH HEIGHT SCHEME  a picture

const { chromium } = require("playwright-core");
const { createInterface } = require("node:readline");

const FLAGS = [
  "--headless",
  "--no-sandbox",
  "--disable-gpu",
  "--disable-quic",
  "--no-first-run",
  "--disable-background-networking",
  "--disable-component-update",
  "--disable-sync",
];

async function main() {
  const [, , executablePath, directory] = process.argv;
  const context = await chromium.launchPersistentContext(directory, {
    executablePath,
    args: FLAGS,
    acceptDownloads: true,
    viewport: { width: 1280, height: 900 },
  });
  const page = context.pages()[0] ?? (await context.newPage());
  page.setDefaultTimeout(60000);
  const errors = [];
  page.on("pageerror", (error) => errors.push(String(error)));
  const act = {
    open: (url) => page.goto(url).then(() => true),
    eval: (expression) => page.evaluate(expression),
    // The page evaluates no strings by itself: its policy forbids it.
    async wait(expression) {
      for (const begun = Date.now(); !(await page.evaluate(expression)); await page.waitForTimeout(50)) {
        if (Date.now() - begun > 40000) throw new Error("never holds");
      }
      return true;
    },
    click: (selector) => page.click(selector).then(() => true),
    key: (key) => page.keyboard.press(key).then(() => true),
    errors: async () => errors,
    async set(rest) {
      const [selector, value] = rest.split(" ");
      const isSelect = await page.$eval(selector, (field) => field.tagName === "SELECT");
      if (isSelect) await page.selectOption(selector, value);
      else {
        await page.fill(selector, value);
        await page.press(selector, "Enter");
      }
      return true;
    },
    async drag(rest) {
      const [from, to] = rest.split(" ").map(Number);
      const box = await page.locator(".u-over").first().boundingBox();
      const y = box.y + box.height / 2;
      await page.mouse.move(box.x + from * box.width, y);
      await page.mouse.down();
      await page.mouse.move(box.x + ((from + to) / 2) * box.width, y);
      await page.mouse.move(box.x + to * box.width, y);
      await page.mouse.up();
      return true;
    },
    async save(rest) {
      const [selector, file] = rest.split(" ");
      const [download] = await Promise.all([page.waitForEvent("download"), page.click(selector)]);
      await download.saveAs(file);
      return download.suggestedFilename();
    },
    async look(rest) {
      const [file, width, height, colorScheme] = rest.split(" ");
      await page.setViewportSize({ width: Number(width), height: Number(height) });
      await page.emulateMedia({ colorScheme });
      await page.waitForTimeout(500);
      await page.screenshot({ path: file });
      return true;
    },
  };
  console.log("ready");
  for await (const line of createInterface({ input: process.stdin })) {
    const [word] = line.split(" ", 1);
    const answer = await act[word](line.slice(word.length + 1)).catch((error) => ({ failed: String(error) }));
    console.log(JSON.stringify(answer ?? null));
  }
  await context.close();
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
