import { accessible, expect, shot, test } from "./fixtures";

test("a lost connection is said, and found again without reloading", async ({ page, daemon }) => {
  await page.goto(daemon.url);
  await expect(page.locator("#state")).toHaveText("ready to scan");
  await daemon.kill();
  await expect(page.locator("#state")).toHaveText("no connection, trying again");
  await page.locator("#scan").click();
  await expect(page.locator("#problem")).toContainText("does not answer");
  await shot(page, "no-connection");
  await daemon.start();
  await expect(page.locator("#state")).toHaveText("ready to scan");
  await page.locator("#scan").click();
  await expect(page).toHaveURL(/#\/scans\//);
  await expect(page.locator("#problem")).toBeEmpty();
});

test("a service with tokens asks for one, refuses a wrong one and keeps the right one", async ({ page, daemon }) => {
  await daemon.kill();
  const token = daemon.addToken("scan");
  await daemon.start();
  await page.goto(daemon.url);
  const dialog = page.getByRole("dialog", { name: "This scanner asks for a token" });
  await expect(dialog).toBeVisible();
  await accessible(page);
  await shot(page, "login");
  await page.locator("#token").fill("wrong");
  await page.keyboard.press("Enter");
  await expect(dialog).toContainText("not known");
  await page.locator("#token").fill(token);
  await page.keyboard.press("Enter");
  await expect(dialog).toBeHidden();
  await expect(page.locator("#state")).toHaveText("ready to scan");
  await page.locator("#scan").click();
  await expect(page).toHaveURL(/#\/scans\//);
  await expect(page.locator("canvas.cloud")).toHaveAttribute("data-drawn", /[1-9]/);
  await page.reload();
  await expect(page.locator("canvas.cloud")).toHaveAttribute("data-drawn", /[1-9]/);
});
