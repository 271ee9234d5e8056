from .array_cache import NO_CACHE as NO_CACHE, Cache as Cache, user_cache as user_cache
from .kernel_cache import use_kernel_cache as use_kernel_cache
