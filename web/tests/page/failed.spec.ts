import { accessible, expect, shot, test } from "./fixtures";

test.describe("an object that is moved during the scan", () => {
  test.use({ rig: { fault: 'kind = "bumped-object"\nat_ms = 1500.0\nobject = "black"\nby_mm = [4.0, 0.0, 0.0]' } });

  test("a failed scan tells the diagnosis and the next step, as the interface does", async ({ page, daemon }) => {
    await page.goto(daemon.url);
    await expect(page.locator("#state")).toHaveText("ready to scan");
    await page.locator("#scan").click();
    await expect(page).toHaveURL(/#\/scans\//);
    await expect(page.locator(".verdict .badge")).toHaveText("✗ failed");
    const [scan] = (await daemon.get("/v1/scans")).scans;
    expect(scan.verdict).toBe("failed");
    const causes = page.locator(".cause");
    await expect(causes).toHaveCount(scan.reasons.length);
    await expect(causes.first().getByRole("heading")).toHaveText("Motion");
    // Word for word what a script is told; the message ends with what to do.
    await expect(causes.first().locator("p")).toContainText(scan.reasons[0].message.slice(1));
    await expect(causes.first()).toContainText("The numbers behind it");
    // Nothing was decoded, but the frames show where it happened.
    const evidence = page.getByRole("img", { name: "Residual at each pixel" });
    await expect.poll(() => evidence.evaluate((image: HTMLImageElement) => image.naturalWidth)).toBeGreaterThanOrEqual(400);
    await accessible(page);
    await shot(page, "failed", true);
  });
});

test.describe("a camera that is pushed at the end of the scan", () => {
  test.use({ rig: { fault: 'kind = "bumped-camera"\nat_ms = 2250.0\nturn_deg = [0.0, 0.4, 0.0]' } });

  test("a doubtful scan shows the evidence: a picture of what does not add up", async ({ page, daemon }) => {
    const scan = await daemon.scan({ label: "pushed" });
    await page.goto(`${daemon.url}/#/scans/${scan.id}`);
    await expect(page.locator(".cause").first().getByRole("heading")).toHaveText("Motion");
    await expect(page.locator(".cause").first().locator("p")).toContainText(scan.reasons[0].message.slice(1));
    const evidence = page.getByRole("img", { name: "Residual at each pixel" });
    await expect.poll(() => evidence.evaluate((image: HTMLImageElement) => image.naturalWidth)).toBeGreaterThanOrEqual(400);
    await expect(page.locator("canvas.cloud")).toHaveAttribute("data-drawn", /[1-9]/);
    await accessible(page);
    await page.locator("canvas.cloud").press("r");
    await shot(page, "doubtful", true);
  });
});
