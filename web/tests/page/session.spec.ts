import { accessible, expect, shot, test } from "./fixtures";

test("the rig is calibrated with a board: guidance, refusal, a dropped view, a reload, the verdict", async ({ page, daemon }) => {
  test.setTimeout(180_000);
  await page.goto(`${daemon.url}/#/calibrations`);
  await expect(page.locator("#state")).toHaveText("ready to scan");
  const form = page.getByRole("form", { name: "A session with a board" });
  await form.getByLabel("Square (mm)").fill("0");
  await form.getByRole("button", { name: "Rig, with a board" }).click();
  await expect(page.locator("#problem")).toContainText(/square/i);
  await form.getByLabel("Square (mm)").fill("18");
  await form.getByRole("button", { name: "Rig, with a board" }).click();

  const run = page.locator("[data-run]");
  const views = run.locator("[data-view]");
  const told = async () => (await daemon.get("/v1/calibrations")).runs[0];
  await expect(run.locator(".badge")).toHaveText("open");
  await expect(run.locator(".advice")).toContainText("Next:");
  const view = async (count: number) => {
    await run.getByRole("button", { name: "Take a view" }).click();
    await expect(views).toHaveCount(count, { timeout: 30_000 });
    await expect(run.getByRole("button", { name: "Take a view" })).toBeEnabled({ timeout: 30_000 });
  };
  await view(1);
  const first = await told();
  // Word for word what a script is told.
  await expect(run.locator(".advice")).toContainText(first.session.missing[0].slice(1));
  await expect(views.first()).toContainText(`${first.session.views[0].corners} corners`);
  await expect(run.getByRole("table", { name: "Corners in the camera's image" }).locator(".covered").first()).toBeVisible();

  await run.getByRole("button", { name: "Calibrate", exact: true }).click();
  await expect(run.locator(".badge")).toHaveText("✗ refused, open", { timeout: 30_000 });
  await expect(run.locator(".cause").first()).toContainText((await told()).refused[0].slice(1));
  await accessible(page);
  await shot(page, "session");

  await view(2);
  await run.getByRole("button", { name: "Drop view-01" }).click();
  await expect(views).toHaveCount(1);
  await expect(views.first()).toContainText("view-02");
  await page.reload();
  await expect(views).toHaveCount(1);
  await expect(run.getByRole("button", { name: "Take a view" })).toBeEnabled();

  for (let count = 2; (await told()).session.missing.length > 0 || count <= 8; count++) {
    expect(count, "guidance comes to an end").toBeLessThan(25);
    await view(count);
  }
  await expect(run.locator(".advice")).toContainText("Nothing is missing");
  await run.getByRole("button", { name: "Calibrate", exact: true }).click();
  await expect(run.locator(".badge")).toHaveText("✓ accepted", { timeout: 60_000 });
  await expect(run.getByRole("button", { name: "calibration.toml" })).toBeVisible();
  await expect(run.getByRole("button", { name: "Take a view" })).toHaveCount(0);
  await accessible(page);
  await shot(page, "session-accepted", true);
});

test("a step of a session costs nothing that was taken before, in any tab", async ({ page, daemon, context }) => {
  await page.goto(`${daemon.url}/#/calibrations`);
  await expect(page.locator("#state")).toHaveText("ready to scan");
  await page.getByRole("button", { name: "Rig, with a board" }).click();
  const run = page.locator("[data-run]");
  const views = run.locator("[data-view]");
  const other = await context.newPage();
  await other.goto(`${daemon.url}/#/calibrations`);
  await expect(other.locator("[data-run]")).toHaveCount(1);

  await run.getByRole("button", { name: "Take a view" }).click();
  await expect(run.locator(".badge")).toHaveText(/running/);
  await expect(run.getByRole("button", { name: "Cancel" })).toHaveCount(0);
  await expect(views).toHaveCount(1, { timeout: 30_000 });
  await expect(run.locator(".badge")).toHaveText("open");

  // What others do meanwhile must not put another button under Enter.
  await run.getByRole("button", { name: "Drop view-01" }).focus();
  await other.getByRole("button", { name: "Take a view" }).click();
  await expect(views).toHaveCount(2, { timeout: 30_000 });
  expect(await page.evaluate(() => document.activeElement?.textContent)).not.toBe("Take a view");

  await run.getByRole("button", { name: "Give up and delete" }).click();
  await expect(run).toHaveCount(0);
  await expect(other.locator("[data-run]")).toHaveCount(0);
  await expect(page.locator("#problem")).toBeHidden();
  await expect(other.locator("#problem")).toBeHidden();
});

test("a session can be given up", async ({ page, daemon }) => {
  await page.goto(`${daemon.url}/#/calibrations`);
  await expect(page.locator("#state")).toHaveText("ready to scan");
  await page.getByRole("button", { name: "Rig, with a board" }).click();
  await page.getByRole("button", { name: "Give up and delete" }).click();
  await expect(page.locator("[data-run]")).toHaveCount(0);
  expect((await daemon.get("/v1/calibrations")).runs).toEqual([]);
});
