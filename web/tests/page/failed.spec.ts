import { accessible, expect, shot, test } from "./fixtures";

test.use({ rig: { fault: 'kind = "bumped-camera"\nat_ms = 1200.0\nturn_deg = [0.0, 0.5, 0.0]' } });

test("a failed scan tells the diagnosis, its evidence and the next step, as the interface does", async ({ page, daemon }) => {
  await page.goto(daemon.url);
  await expect(page.locator("#state")).toHaveText("ready to scan");
  await page.locator("#scan").click();
  await expect(page).toHaveURL(/#\/scans\//);
  const [scan] = (await daemon.get("/v1/scans")).scans;
  expect(scan.verdict).not.toBe("ok");
  const causes = page.locator(".cause");
  await expect(causes).toHaveCount(scan.reasons.length);
  await expect(causes.first().getByRole("heading")).toHaveText("Motion");
  // Word for word what a script is told; the message ends with what to do.
  const message: string = scan.reasons[0].message;
  await expect(causes.first().locator("p")).toContainText(message.slice(1));
  const evidence = page.getByRole("img", { name: "Residual at each pixel" });
  await expect.poll(() => evidence.evaluate((image: HTMLImageElement) => image.naturalWidth)).toBe(400);
  await shot(page, "failed");
  await accessible(page);
});
