// A dataset's page: its signals.

import { begin } from './figures.js';

begin();
