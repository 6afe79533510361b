// What the tests share: the built server on a free port, a headless browser that may not leave this machine,
// and the rule that a missing tool skips a test on a desk and fails it in CI.
import { spawn } from 'node:child_process';
import { existsSync, mkdirSync, mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join, resolve } from 'node:path';
import { fileURLToPath } from 'node:url';
import { chromium } from 'playwright-core';

export const HERE = dirname(fileURLToPath(import.meta.url));
const PROJECT = resolve(HERE, '../..');
const CHROMIUM = process.env.CHROMIUM ?? '/usr/bin/chromium';
const ROOFTILE = process.env.ROOFTILE ?? ['release', 'debug'].map((profile) => join(PROJECT, 'target', profile, 'rooftile')).find(existsSync);
export const TILESET = process.env.TILESET && resolve(process.env.TILESET);
const SHOTS = process.env.SHOTS ?? join(HERE, 'shots');

/** Why a test cannot run here, for `{ skip }`; in CI that is an error instead. */
export function missing(...needs) {
  const known = {
    tileset: [TILESET && existsSync(join(TILESET, 'tileset.json')), 'TILESET names no folder with a tileset.json'],
    chromium: [existsSync(CHROMIUM), `no browser at ${CHROMIUM}; set CHROMIUM`],
    rooftile: [ROOFTILE && existsSync(ROOFTILE), 'no built rooftile; run cargo build --release or set ROOFTILE'],
    cesium: [existsSync(join(PROJECT, 'tools/viewer/node_modules/cesium/Build/Cesium/Cesium.js')), 'no CesiumJS; run npm ci in tools/viewer'],
    schemas: [process.env.SCHEMAS && existsSync(process.env.SCHEMAS), 'SCHEMAS names no folder with the 3D Tiles JSON schemas'],
  };
  const why = needs.filter((need) => !known[need][0]).map((need) => known[need][1]).join('; ');
  if (!why) return false;
  if (process.env.CI) throw new Error(why);
  console.warn(`SKIPPED: ${why}`);
  return why;
}

/** Runs `rooftile serve` on a free port. */
export async function serve(folder) {
  const child = spawn(ROOFTILE, ['serve', folder, '--bind', '127.0.0.1:0'], { stdio: ['ignore', 'ignore', 'pipe'] });
  let said = '';
  const url = await new Promise((done, failed) => {
    const limit = setTimeout(() => { child.kill('SIGKILL'); failed(new Error(`rooftile serve named no URL in 20 s: ${said}`)); }, 20000);
    child.stderr.on('data', (text) => {
      said += text;
      const found = /http:\/\/127\.0\.0\.1:\d+/.exec(said);
      if (found) { clearTimeout(limit); done(found[0]); }
    });
    child.on('exit', (code) => { clearTimeout(limit); failed(new Error(`rooftile serve ended with ${code}: ${said}`)); });
  });
  /** Asks it to stop; resolves to the exit code. */
  const stop = () => new Promise((done) => {
    const limit = setTimeout(() => child.kill('SIGKILL'), 15000);
    child.once('exit', (code) => { clearTimeout(limit); done(code); });
    child.kill('SIGTERM');
  });
  return { url, stop };
}

/** A browser with an empty profile and WebGL in software. */
export async function openBrowser() {
  const profile = mkdtempSync(join(tmpdir(), 'rooftile-browser-'));
  const context = await chromium.launchPersistentContext(profile, {
    executablePath: CHROMIUM,
    headless: true,
    viewport: { width: 960, height: 640 },
    args: [
      '--no-sandbox', '--no-first-run', '--disable-background-networking', '--disable-component-update', '--disable-dev-shm-usage',
      '--use-angle=swiftshader', '--enable-unsafe-swiftshader',
      '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1',
    ],
  });
  const close = async () => { await context.close(); rmSync(profile, { recursive: true, force: true }); };
  return { context, close };
}

/** A page, and everything that went wrong in it: console errors, exceptions, refused requests, requests to elsewhere. */
export async function openPage(browser, url) {
  const page = await browser.context.newPage();
  const faults = [];
  page.on('console', (m) => { if (m.type() === 'error') faults.push(`console: ${m.text()}`); });
  page.on('pageerror', (e) => faults.push(`exception: ${e.stack ?? e}`));
  page.on('response', (r) => { if (r.status() >= 400) faults.push(`${r.status()} ${r.url()}`); });
  await page.route('**', (route) => {
    const { protocol, hostname } = new URL(route.request().url());
    if (hostname === '127.0.0.1' || ['data:', 'blob:'].includes(protocol)) return route.continue();
    faults.push(`left the machine: ${route.request().url()}`);
    return route.abort();
  });
  await page.goto(url);
  const shot = async (name) => { mkdirSync(SHOTS, { recursive: true }); await page.screenshot({ path: join(SHOTS, `${name}.png`) }); };
  return { page, faults, shot };
}
