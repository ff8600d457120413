import { accessible, expect, shot, test } from "./fixtures";

test("the noise of the camera is calibrated, and the result told", async ({ page, daemon }) => {
  await page.goto(`${daemon.url}/#/calibrations`);
  await expect(page.locator("#state")).toHaveText("ready to scan");
  await page.getByRole("button", { name: "Camera noise" }).click();
  const run = page.locator("[data-run]");
  await expect(run.locator(".badge")).toHaveText("✓ accepted", { timeout: 40_000 });
  const [told] = (await daemon.get("/v1/calibrations")).runs;
  await expect(run.locator("li")).toHaveCount(told.summary.length);
  await accessible(page);
  await shot(page, "calibrations");
});

test("turning the polarizer is watched, live", async ({ page, daemon }) => {
  await page.goto(`${daemon.url}/#/calibrations`);
  await expect(page.locator("#state")).toHaveText("ready to scan");
  await page.getByRole("button", { name: "Turn the polarizer" }).click();
  await expect(page.locator(".advice")).not.toBeEmpty();
  const values = () => page.locator(".live .small").textContent().then((text) => Number.parseInt(text ?? "0"));
  const first = await values();
  await expect.poll(values).toBeGreaterThan(first);
  await shot(page, "polarizer");
  await page.getByRole("button", { name: "Enough" }).click();
  await expect(page.locator("[data-run] .badge")).toHaveText("done");
});

test("the rig's health and devices; and the projector holds a picture", async ({ page, daemon }) => {
  await page.goto(daemon.url);
  await expect(page.locator("#state")).toHaveText("ready to scan");
  await page.getByLabel("Projector holds").selectOption("crosshair");
  await expect.poll(async () => (await daemon.get("/v1/status")).showing).toBe("crosshair");
  await page.getByRole("link", { name: "Rig" }).click();
  await expect(page.getByText("simulated LCD projector, sim-projector-0 (sim)")).toBeVisible();
  await expect(page.getByText("ready to scan").last()).toBeVisible();
  await expect(page.getByText("crosshair")).toBeVisible();
  await accessible(page);
  await shot(page, "rig");
});

test("the interface is described without a network", async ({ page, daemon }) => {
  await page.goto(`${daemon.url}/docs`);
  await expect(page.getByText("/v1/scans/{id}/cancel").first()).toBeVisible();
});

for (const [name, scheme, width, height] of [
  ["dark", "dark", 1280, 720],
  ["tablet", "light", 768, 1024],
] as const) {
  test(`it is readable and fits: ${name}`, async ({ page, daemon }) => {
    const scan = await daemon.scan({ label: "two plates", tags: ["demo"] });
    await page.emulateMedia({ colorScheme: scheme });
    await page.setViewportSize({ width, height });
    for (const [part, view] of [["", "scan"], [`#/scans/${scan.id}`, "cloud"]]) {
      await page.goto(`${daemon.url}/${part}`);
      if (view === "cloud") await expect(page.locator("canvas.map")).toBeVisible();
      else await expect(page.locator("img.frame")).toBeVisible();
      await expect(page.locator("#state")).toHaveText("ready to scan");
      const over = await page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
      expect(over, "nothing sticks out sideways").toBe(0);
      await accessible(page);
      await shot(page, `${name}-${view}`);
    }
  });
}

test("two million points stay usable in software rendering", async ({ page, daemon }) => {
  const scan = await daemon.scan();
  const count = 2_000_000;
  const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${count}\nproperty float x\nproperty float y\nproperty float z\nproperty float sigma_z\nend_header\n`;
  const body = Buffer.alloc(header.length + count * 16);
  body.write(header, "latin1");
  for (let index = 0, at = header.length; index < count; index++, at += 16) {
    const [x, y] = [(index % 1600) / 8 - 100, Math.floor(index / 1600) / 8 - 78];
    body.writeFloatLE(x, at);
    body.writeFloatLE(y, at + 4);
    body.writeFloatLE(1000 + 20 * Math.sin(x / 12) * Math.cos(y / 15), at + 8);
    body.writeFloatLE(0.1, at + 12);
  }
  await page.route("**/cloud.ply", (route) => route.fulfill({ body, contentType: "application/octet-stream" }));
  await page.goto(`${daemon.url}/#/scans/${scan.id}`);
  const canvas = page.locator("canvas.cloud");
  await expect(canvas).toHaveAttribute("data-drawn", /[1-9]/, { timeout: 30_000 });
  // It turns by itself at first; after a while the level of detail settles.
  await page.waitForTimeout(3000);
  const took: number[] = [];
  for (let index = 0; index < 25; index++) {
    took.push(Number(await canvas.getAttribute("data-frame-ms")));
    await page.waitForTimeout(100);
  }
  const late = took.sort((a, b) => a - b);
  const median = late[Math.floor(late.length / 2)];
  const few = Number(await canvas.getAttribute("data-drawn"));
  console.log(`2 000 000 points: a picture every ${median} ms while it turns, of ${few} points`);
  expect(median, "milliseconds from picture to picture").toBeLessThan(200);
  await canvas.press("r");
  await expect(canvas).toHaveAttribute("data-drawn", String(count), { timeout: 30_000 });
  await shot(page, "two-million");
});
