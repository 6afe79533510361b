// 3DTilesRendererJS shows the tileset too, from a page on another origin.
//   TILESET=folder [SHOTS=folder] [NAME=prefix] node --test three.test.mjs
import assert from 'node:assert/strict';
import { createReadStream, existsSync } from 'node:fs';
import { createServer } from 'node:http';
import { extname, join, normalize } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { HERE, TILESET, missing, openBrowser, openPage, serve } from './browser.mjs';

const TYPES = { '.html': 'text/html', '.js': 'text/javascript' };

/** Hands out this folder's page and packages. */
function pages() {
  const server = createServer((request, response) => {
    const path = join(HERE, normalize(decodeURIComponent(new URL(request.url, 'http://x').pathname)));
    if (!TYPES[extname(path)] || !existsSync(path)) return response.writeHead(path.endsWith('favicon.ico') ? 204 : 404).end();
    response.writeHead(200, { 'content-type': TYPES[extname(path)] });
    createReadStream(path).pipe(response);
  });
  return new Promise((done) => server.listen(0, '127.0.0.1', () => done(server)));
}

describe('3DTilesRendererJS', { skip: missing('tileset', 'chromium', 'rooftile') }, () => {
  let server, own, browser;
  before(async () => {
    server = await serve(TILESET);
    own = await pages();
    browser = await openBrowser();
  });
  after(async () => {
    await browser?.close();
    own?.closeAllConnections();
    own?.close();
    await server?.stop();
  });

  test('the tileset is loaded from another origin and drawn', async () => {
    const from = `http://127.0.0.1:${own.address().port}/three.html?tileset=${encodeURIComponent(`${server.url}/tileset.json`)}`;
    const { page, faults, shot } = await openPage(browser, from);
    await page.waitForFunction('window.look').catch((error) => assert.fail([error.message, ...faults].join('\n')));
    const seen = await page.evaluate(() => window.look(120000));
    await shot(`${process.env.NAME ?? 'viewer'}-three`);
    assert.deepEqual(seen.failed, []);
    assert.ok(seen.settled, 'not settled in 120 s');
    assert.ok(seen.drawn > 0.05, `${(100 * seen.drawn).toFixed(1)} % of the view is drawn`);
    assert.ok(seen.tiles > 0 && seen.triangles > 0);
    assert.deepEqual(faults, []);
  });
});
