import { accessible, expect, shot, test } from "./fixtures";

test("clouds of a series are shown as they come, seen from where the operator looks", async ({ page, daemon }) => {
  await page.goto(daemon.url);
  await expect(page.locator("#state")).toHaveText("ready to scan");
  const asked: string[] = [];
  page.on("request", (request) => {
    if (request.url().includes("/sample.ply")) asked.push(new URL(request.url()).pathname);
  });
  await page.getByLabel("How many").fill("4");
  await page.getByLabel("Label").first().fill("series");
  await page.locator("#scan").click();
  const live = page.locator(".live");
  await expect(live).toHaveAttribute("open", "");
  await expect(page.locator("#live-about")).toHaveText(/ok series, [\d\u202f]+ of [\d\u202f]+ points/);
  await page.locator("#live-cloud").press("ArrowUp");
  await expect.poll(async () => (await daemon.get("/v1/scans?state=done")).scans.length).toBe(4);
  const newest = (await daemon.get("/v1/scans?limit=1")).scans[0];
  await expect(live).toHaveAttribute("data-shown", newest.id);
  const one = asked.length;
  expect(new Set(asked).size, "none is fetched twice").toBe(one);
  expect(one, "several clouds were shown").toBeGreaterThan(1);
  expect(new URL(page.url()).hash, "the page stays").toMatch(/^(#\/)?$/);
  const points = Number(await page.locator("#live-cloud").getAttribute("data-drawn"));
  expect(points).toBe(Math.min(50_000, newest.points));
  await shot(page, "series");
  await accessible(page);

  // A scan that somebody else asks for is looked at as well, from the same side.
  const picture = () => page.locator("#live-cloud").evaluate((canvas: HTMLCanvasElement) => canvas.toDataURL());
  const turned = await picture();
  await page.locator("#live-cloud").press("r");
  await expect.poll(picture).not.toBe(turned);
  const other = await daemon.scan({ label: "a script's" });
  await expect(live).toHaveAttribute("data-shown", other.id);
  await expect(page.locator("#live-about")).toContainText("a script's");

  // Whoever does not look needs no clouds.
  await page.getByText("Latest cloud").click();
  await expect(live).not.toHaveAttribute("open", "");
  const before = asked.length;
  await daemon.scan();
  await expect(page.locator(".scans > li")).toHaveCount(6);
  expect(asked.length).toBe(before);
  await page.getByText("Latest cloud").click();
  await expect.poll(() => asked.length).toBe(before + 1);
});

test.describe("at the pace of a real rig", () => {
  test.use({ rig: { set: ['sim.pacing="real-time"'] } });

  test("a series is ended, and a scan without a cloud is told", async ({ page, daemon }) => {
    await page.goto(daemon.url);
    await expect(page.locator("#state")).toHaveText("ready to scan");
    await page.getByLabel("How many").fill("8");
    await page.locator("#scan").click();
    await expect(page.locator("#cancel-waiting")).toHaveText("Cancel the 7 waiting");
    await page.locator("#cancel-waiting").click();
    await expect(page.locator("#cancel-waiting")).toBeHidden();
    await page.locator("#cancel").click();
    await expect(page.locator("#state")).toHaveText("ready to scan");
    await expect(page.locator("#live-about")).toHaveText("The next scan is shown here.");

    await daemon.scan({ exposure_us: 1 }).catch(() => undefined);
    await expect(page.locator("#live-failed")).toContainText("has no cloud");
  });
});
