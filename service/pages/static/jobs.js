// The list of jobs: fresh every few seconds while one of them is open and the page is looked at.

import { refresh } from './live.js';

const EVERY_MS = 2000;
const list = document.querySelector('[data-live="jobs"]');

async function look() {
  if (!document.hidden && list.dataset.open === '1') await refresh().catch(() => null);
  setTimeout(look, EVERY_MS);
}

setTimeout(look, EVERY_MS);
