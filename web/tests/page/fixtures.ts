/** A page that must ask nobody but its service, and a service for it. */

import AxeBuilder from "@axe-core/playwright";
import { test as base, expect, type Page } from "@playwright/test";
import { readFileSync } from "node:fs";
import { join, resolve } from "node:path";
import { Daemon, type Rig } from "./daemon";

const SHOTS = resolve(import.meta.dirname, "../../../target/page/screenshots");

/** The page as built last, where somebody works on it and does not want to build the program each time. */
async function fromDisk(page: Page): Promise<void> {
  const folder = resolve(import.meta.dirname, "../../dist");
  await page.context().route(/:\d+\/(assets\/(page|cloud)\.\w+)?$/, async (route) => {
    const response = await route.fetch();
    const path = new URL(route.request().url()).pathname;
    const { "content-encoding": _, "content-length": __, ...headers } = response.headers();
    await route.fulfill({ response, headers, body: readFileSync(join(folder, path === "/" ? "index.html" : path)) });
  });
}

interface Fixtures {
  rig: Rig;
  daemon: Daemon;
  /** Everything that the page asked for, what its console said, and what its policy refused. */
  watched: { hosts: Set<string>; errors: string[] };
}

export const test = base.extend<Fixtures>({
  rig: [{}, { option: true }],
  daemon: async ({ rig }, use) => {
    const daemon = await new Daemon(rig).start();
    await use(daemon);
    await daemon.end();
  },
  watched: [
    async ({ page, daemon }, use) => {
      if (process.env.POLSCAN_PAGE_FROM_DISK) await fromDisk(page);
      const watched = { hosts: new Set<string>(), errors: [] as string[] };
      page.on("request", (request) => {
        const address = new URL(request.url());
        if (address.protocol !== "blob:" && address.protocol !== "data:") watched.hosts.add(address.host);
      });
      page.on("pageerror", (error) => watched.errors.push(String(error)));
      page.on("console", (message) => {
        // Drivers speak of their speed, and answers that are errors are said by the page itself.
        const text = message.text();
        if (message.type() === "error" && !text.startsWith("Failed to load resource")) watched.errors.push(text);
      });
      await use(watched);
      expect([...watched.hosts], "no request leaves the host").toEqual([new URL(daemon.url).host]);
      expect(watched.errors, "nothing fails unseen").toEqual([]);
    },
    { auto: true },
  ],
});

/** No serious problem of accessibility. */
export async function accessible(page: Page): Promise<void> {
  const { violations } = await new AxeBuilder({ page }).withTags(["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]).analyze();
  const grave = violations.filter((one) => one.impact === "serious" || one.impact === "critical");
  expect(grave.map((one) => `${one.id}: ${one.nodes.map((node) => `${node.target} ${node.failureSummary}`).join("; ")}`)).toEqual([]);
}

/** Keeps a picture of the page for people. */
export async function shot(page: Page, name: string, fullPage = false): Promise<void> {
  await page.screenshot({ path: join(SHOTS, `${name}.png`), fullPage });
}

/** Waits until all points of a cloud are drawn; gives back how many. */
export async function drawn(page: Page): Promise<number> {
  const count = (await page.locator("#cloud-count").textContent())?.replace(/\D/g, "");
  await expect(page.locator("canvas.cloud")).toHaveAttribute("data-drawn", count ?? "none");
  return Number(count);
}

export { expect };
