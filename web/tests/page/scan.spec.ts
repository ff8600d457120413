import { accessible, drawn, expect, shot, test } from "./fixtures";

test.describe("at the pace of a real rig", () => {
  test.use({ rig: { set: ['sim.pacing="real-time"'] } });

  test("a scan by keyboard: progress, then the cloud turns on screen, with the report in words", async ({ page, daemon }) => {
    await page.goto(daemon.url);
    await expect(page.locator("#state")).toHaveText("ready to scan");
    await expect(page.locator("img.frame")).toBeVisible();
    await expect(page.locator(".light")).toContainText("projector is dark");
    await page.getByLabel("Projector holds").selectOption("white");
    await expect(page.locator(".light")).toContainText("light is right");
    const bars = await page.locator("canvas.histogram").evaluate((canvas: HTMLCanvasElement) =>
      canvas.getContext("2d")!.getImageData(0, 0, canvas.width, canvas.height).data.some((value) => value > 0));
    expect(bars, "the histogram shows something").toBe(true);

    await page.getByLabel("Label").first().fill("two plates");
    await page.getByLabel("Tags").fill("plates, demo");
    await page.getByRole("button", { name: "Scan", exact: true }).focus();
    await page.keyboard.press("Enter");
    await expect(page.locator("#step")).toHaveText(/Pattern \d+ of 36/);
    await expect(page.locator("#cancel")).toBeEnabled();
    await expect(page.locator("#state")).toHaveText("scanning");
    await shot(page, "scanning");

    await expect(page).toHaveURL(/#\/scans\//);
    await expect(page.locator(".verdict")).toContainText("ok");
    // It turns by itself until somebody takes hold of it.
    const picture = () => page.locator("canvas.cloud").evaluate((canvas: HTMLCanvasElement) => canvas.toDataURL());
    await expect(page.locator("canvas.cloud")).toHaveAttribute("data-drawn", /[1-9]/);
    const before = await picture();
    await expect.poll(picture).not.toBe(before);
    await page.locator("canvas.cloud").press("ArrowLeft");
    expect(await drawn(page)).toBe((await daemon.get("/v1/scans")).scans[0].points);
    await shot(page, "cloud");
    await accessible(page);
  });

  test("a scan is cancelled", async ({ page, daemon }) => {
    await page.goto(daemon.url);
    await expect(page.locator("#state")).toHaveText("ready to scan");
    await page.locator("#scan").click();
    await expect(page.locator("#step")).toHaveText(/Pattern \d+ of 36/);
    await page.locator("#cancel").click();
    await expect(page.locator("#step")).toHaveText("Last scan: cancelled");
    await expect(page.locator(".scans .badge")).toHaveText("cancelled");
    await expect(page.locator("#state")).toHaveText("ready to scan");
  });
});

test.describe("on a tiny rig", () => {
  test.use({ rig: { scale: 8 } });

  test("list: thumbnails, verdicts, filter and pages", async ({ page, daemon }) => {
    // Fourteen scans take their time on a busy machine.
    test.slow();
    await daemon.scan({ label: "wanted", tags: ["blue"] });
    for (let index = 0; index < 13; index++) await daemon.scan({ label: `other ${index}`, mode: "fast" });
    await page.goto(daemon.url);
    const rows = page.locator(".scans > li");
    await expect(rows).toHaveCount(12);
    await expect.poll(() => page.locator("img.thumb").first().evaluate((image: HTMLImageElement) => image.naturalWidth)).toBeGreaterThan(10);
    await page.getByRole("button", { name: "Older" }).click();
    await expect(rows).toHaveCount(2);
    await expect(rows.last()).toContainText("wanted");
    await page.getByRole("button", { name: "blue" }).click();
    await expect(rows).toHaveCount(1);
    await expect(page.getByLabel("Tag", { exact: true })).toHaveValue("blue");
    await page.getByLabel("Tag", { exact: true }).fill("");
    await page.getByLabel("Verdict").selectOption("failed");
    await expect(page.locator(".scans .none")).toHaveText("No scan fits.");
    await page.getByLabel("Verdict").selectOption("all");
    await expect(rows).toHaveCount(12);
    await shot(page, "list");
  });
});

test("the cloud is coloured, measured and cut, and maps tell their values", async ({ page, daemon }) => {
  const scan = await daemon.scan({ label: "measured" });
  await page.goto(`${daemon.url}/#/scans/${scan.id}`);
  const canvas = page.locator("canvas.cloud");
  await expect(page.locator(".legend .bar")).toBeVisible();
  await canvas.press("r");
  await drawn(page);
  const coloured = new Set<string>();
  for (const by of ["depth", "sigma", "class", "intensity"]) {
    await page.getByLabel("Colour by").selectOption(by);
    await drawn(page);
    coloured.add(await canvas.evaluate((element: HTMLCanvasElement) => element.toDataURL()));
  }
  expect(coloured.size, "each colouring looks different").toBe(4);
  await page.getByLabel("Colour by").selectOption("depth");

  await page.getByLabel("Tool").selectOption("distance");
  const box = (await canvas.boundingBox())!;
  const at = (x: number, y: number) => ({ position: { x: box.width * x, y: box.height * y } });
  await canvas.click(at(0.45, 0.5));
  await expect(page.locator(".result")).toContainText("Now the other end");
  await canvas.click(at(0.55, 0.5));
  await expect(page.locator(".result")).toHaveText(/^Distance \d+\.\d\d mm/);
  // The same by keyboard: the point under the cross, twice.
  await canvas.press("Enter");
  await expect(page.locator(".result")).toContainText("Now the other end");
  await canvas.press("Enter");
  await expect(page.locator(".result")).toHaveText(/^Distance 0\.00 mm/);

  // On the white plate, whose flatness the report tells: 0.3 mm.
  await page.getByLabel("Tool").selectOption("section");
  await canvas.click(at(0.62, 0.4));
  await canvas.click(at(0.72, 0.45));
  await expect(page.locator(".result")).toHaveText(/^Section of [\d\u202f]+ points, line fit RMSE \d+\.\d{3} mm/);
  const rmse = /RMSE (\d+\.\d+) mm/.exec((await page.locator(".result").textContent()) ?? "");
  expect(Number(rmse?.[1]), "millimetres off the line").toBeLessThan(1);
  await expect(page.locator("canvas.profile")).toBeVisible();
  await shot(page, "section", true);

  const map = page.locator("canvas.map");
  await map.scrollIntoViewIfNeeded();
  await map.hover();
  await expect(page.locator(".value")).toHaveText(/^\(\d+, \d+\): depth \d+\.\d\d mm, projector column/);
  const before = await page.locator(".value").textContent();
  await map.press("ArrowRight");
  await expect(page.locator(".value")).not.toHaveText(before!);
  await page.locator("#map").selectOption("class");
  await shot(page, "map");
});
