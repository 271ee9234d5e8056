from .array_cache import NO_CACHE as NO_CACHE
from .array_cache import Cache as Cache
from .array_cache import user_cache as user_cache
from .kernel_cache import use_kernel_cache as use_kernel_cache
