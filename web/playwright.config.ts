import { defineConfig } from "@playwright/test";

// Tests that fail for one reason: none is tried twice, and each has a service of its own.
export default defineConfig({
  testDir: "tests",
  outputDir: "../target/page/results",
  fullyParallel: false,
  workers: 1,
  retries: 0,
  forbidOnly: true,
  timeout: 60_000,
  expect: { timeout: 15_000 },
  reporter: [["list"]],
  projects: [
    { name: "modules", testDir: "tests/unit" },
    {
      name: "page",
      testDir: "tests/page",
      use: {
        browserName: "chromium",
        viewport: { width: 1280, height: 720 },
        colorScheme: "light",
        launchOptions: {
          executablePath: process.env.POLSCAN_CHROMIUM ?? "/usr/bin/chromium",
          // Software rendering, as on a machine without a GPU.
          args: ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox"],
        },
      },
    },
  ],
});
