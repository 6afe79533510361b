// The page of `rooftile serve`, in a real browser.
//   TILESET=folder [SHOTS=folder] [NAME=prefix of the screenshots] node --test viewer.test.mjs
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { TILESET, missing, openBrowser, openPage, serve } from './browser.mjs';

const NAME = process.env.NAME ?? 'viewer';
// A view may take this long to load where everything is drawn in software, ms.
const PATIENCE = 120000;
/** The same colour but for rounding: a style passes through 8-bit linear light, coarse where it is dark. */
const near = (a, b) => [1, 3, 5].every((at) => Math.abs(parseInt(a.slice(at, at + 2), 16) - parseInt(b.slice(at, at + 2), 16)) <= 5);

describe('the page', { skip: missing('tileset', 'chromium', 'rooftile', 'cesium') }, () => {
  let server, browser, page, faults, shot;
  const call = (name, ...args) => page.evaluate(([name, args]) => window.rooftile[name](...args), [name, args]);
  const settled = async () => assert.ok((await call('settle', PATIENCE)).settled, `not settled in ${PATIENCE / 1000} s`);

  before(async () => {
    server = await serve(TILESET);
    browser = await openBrowser();
    ({ page, faults, shot } = await openPage(browser, server.url));
    await page.waitForFunction('window.rooftile');
    await call('ready');
  });
  after(async () => {
    await browser?.close();
    await server?.stop();
  });

  test('the whole tileset is in view and drawn', async () => {
    await settled();
    const { drawn, distinct } = await call('colours');
    await shot(`${NAME}-texture`);
    assert.ok(drawn > 0.05, `${(100 * drawn).toFixed(1)} % of the view is drawn`);
    assert.ok(distinct > 50, `only ${distinct} colours: no texture`);
    assert.ok((await call('stats')).triangles > 0);
  });

  test('by class, the colours of at least three classes are seen', async () => {
    await page.getByText('By class').click();
    assert.equal((await call('stats')).mode, 'class');
    await settled();
    await shot(`${NAME}-class`);
    await call('setMode', 'class', 1); // no photo below: exact colours
    await settled();
    const { shares } = await call('colours');
    const { classes } = await call('stats');
    const seen = Object.entries(classes).filter(([, colour]) => Object.keys(shares).some((c) => near(c, colour))).map(([name]) => name);
    assert.ok(seen.length >= 3, `seen: ${seen}; classes: ${JSON.stringify(classes)}; colours: ${JSON.stringify(shares)}`);
    const legend = await page.locator('#legend li').allTextContents();
    assert.deepEqual(legend.map((t) => t.trim()), Object.keys(classes));
    await call('setMode', 'texture');
  });

  test('a click tells the class and the error of the tile', async () => {
    await settled();
    // Somewhere near the middle there is a surface, whatever the tileset.
    let found = null;
    for (const [dx, dy] of [[0, 0], [60, 0], [-60, 0], [0, 60], [0, -60], [120, 80], [-120, 80]]) {
      found = await call('pick', 480 + dx, 320 + dy);
      if (found?.class) break;
    }
    assert.equal(typeof found?.class, 'string');
    assert.ok(Number.isFinite(found.geometricError) && found.geometricError >= 0, `geometricError ${found.geometricError}`);
    const bounds = Object.values(found.perClass);
    assert.ok(bounds.length > 0 && bounds.every(({ values }) => Object.values(values).every(Number.isFinite)), `no numbers per class: ${JSON.stringify(found)}`);
    const card = page.locator('#card');
    assert.match(await card.innerText(), new RegExp(`${found.class}[^]*geometric error`));
    await shot(`${NAME}-pick`);
    await page.keyboard.press('Escape');
    assert.equal(await card.isVisible(), false);
  });

  test('a mouse click picks too', async () => {
    await page.mouse.click(480, 320);
    await page.locator('#card').waitFor({ state: 'visible', timeout: 10000 });
    await page.locator('#card-close').click();
  });

  test('the slider of the screen-space error changes what is drawn', async () => {
    const seen = {};
    for (const pixels of [64, 0.5]) {
      await page.locator('#sse').fill(String(Math.log2(pixels)));
      await settled();
      seen[pixels] = await call('stats');
      assert.equal(seen[pixels].sse, pixels);
    }
    assert.ok(seen[0.5].triangles > seen[64].triangles, `${seen[64].triangles} triangles at 64 px, ${seen[0.5].triangles} at 0.5 px`);
    assert.ok(seen[0.5].tiles !== seen[64].tiles, `${seen[64].tiles} tiles at 64 px, ${seen[0.5].tiles} at 0.5 px`);
    await shot(`${NAME}-fine`);
    await call('setSse', 16);
  });

  test('bounding boxes and wireframe can be switched on and off by key', async () => {
    const before = (await settled(), await call('colours'));
    await page.locator('#boxes').focus();
    await page.keyboard.press('Space');
    await page.locator('#wireframe').focus();
    await page.keyboard.press('Space');
    await settled();
    await shot(`${NAME}-wireframe`);
    assert.notEqual((await call('colours')).drawn, before.drawn);
    await page.locator('#boxes').uncheck();
    await page.locator('#wireframe').uncheck();
    await settled();
    assert.ok(Math.abs((await call('colours')).drawn - before.drawn) < 0.01);
  });

  test('the arrow keys turn the view', async () => {
    const canvas = page.locator('#view canvas');
    await canvas.focus();
    await settled();
    const before = await canvas.screenshot();
    for (let i = 0; i < 9; i++) await page.keyboard.press('ArrowLeft');
    await settled();
    assert.ok(!before.equals(await canvas.screenshot()), 'the picture is the same');
    await call('view', { heading: 30, pitch: -89, range: 100 });
    await settled();
    assert.ok((await call('colours')).drawn > 0.05, 'nothing is drawn from above');
    await shot(`${NAME}-above`);
  });

  test('a tile that cannot be loaded is told and counted', async () => {
    const other = await openPage(browser, 'about:blank');
    await other.page.route('**/*.glb?*', (route) => route.fulfill({ status: 404, body: 'gone' }));
    await other.page.goto(server.url);
    const line = other.page.locator('#error');
    await line.waitFor({ state: 'visible', timeout: PATIENCE });
    assert.match(await line.innerText(), /\.glb/);
    assert.ok((await other.page.evaluate(() => window.rooftile.stats())).failed > 0);
    await other.page.close();
  });

  test('nothing failed and nothing left the machine', async () => {
    assert.deepEqual(await page.evaluate(() => window.rooftile.errors), []);
    assert.deepEqual(faults, []);
    assert.equal(await page.locator('#error').isVisible(), false);
  });
});

describe('the server', { skip: missing('tileset', 'rooftile') }, () => {
  test('it ends with 0 when asked to stop, also with a connection open', async () => {
    const server = await serve(TILESET);
    assert.equal((await fetch(`${server.url}/healthz`)).status, 200);
    assert.equal(await server.stop(), 0);
  });
});
